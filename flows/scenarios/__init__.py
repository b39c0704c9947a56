"""Scenarios shipped with the package."""
