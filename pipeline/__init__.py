"""The science: pure functions of arrays and one typed configuration."""
