"""Time zones, plugins that can be asked for, heartbeats of runs, accepted products, names of releases."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "2"
down_revision = "1"

# Only what is read here, as it is at this version.
_campaign = sa.table("campaign", sa.column("id", sa.Integer), sa.column("timezone", sa.String))
_archive = sa.table(
    "archive", sa.column("id", sa.Integer), sa.column("campaign_id", sa.Integer), sa.column("header", sa.JSON)
)
_lineage = sa.table("lineage", sa.column("key", sa.String), sa.column("document", sa.JSON))


def upgrade() -> None:
    """Make the new columns and tables, and fill them from what headers and lineages say."""
    op.add_column("campaign", sa.Column("timezone", sa.String(64)))
    op.add_column("run", sa.Column("heartbeat", sa.BigInteger))
    op.add_column("run", sa.Column("progress", sa.JSON))
    op.add_column("product", sa.Column("accepted", sa.BigInteger))
    given = sa.text("accepted IS NOT NULL")
    op.create_index(
        "uq_product_accepted", "product", ["archive_id"], unique=True, sqlite_where=given, postgresql_where=given
    )
    plugin = op.create_table(
        "plugin",
        sa.Column("lineage_key", sa.String(64), nullable=False),
        sa.Column("role", sa.String(20), nullable=False),
        sa.Column("number", sa.SmallInteger, autoincrement=False, nullable=False),
        sa.Column("name", sa.String(100), nullable=False),
        sa.Column("version", sa.Integer, nullable=False),
        sa.Column("parameters", sa.JSON, nullable=False),
        sa.PrimaryKeyConstraint("lineage_key", "role", "number", name="pk_plugin"),
        sa.ForeignKeyConstraint(["lineage_key"], ["lineage.key"], "fk_plugin_lineage_key", ondelete="CASCADE"),
    )
    op.create_index("ix_plugin_role_name", "plugin", ["role", "name"])
    op.create_table(
        "alias",
        sa.Column("name", sa.String(100), nullable=False),
        sa.Column("created", sa.BigInteger, nullable=False),
        sa.Column("note", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_alias"),
    )
    op.create_table(
        "alias_product",
        sa.Column("alias", sa.String(100), nullable=False),
        sa.Column("product_id", sa.Integer, nullable=False),
        sa.PrimaryKeyConstraint("alias", "product_id", name="pk_alias_product"),
        sa.ForeignKeyConstraint(["alias"], ["alias.name"], "fk_alias_product_alias", ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["product_id"], ["product.id"], "fk_alias_product_product_id"),
    )
    op.create_index("ix_alias_product_product_id", "alias_product", ["product_id"])

    connection = op.get_bind()
    for row in connection.execute(sa.select(_archive).order_by(_archive.c.id)).all():
        site = row.header.get("site") if isinstance(row.header, dict) else None
        zone = site.get("timezone") if isinstance(site, dict) else None
        if isinstance(zone, str) and len(zone) <= 64:
            connection.execute(sa.update(_campaign).where(_campaign.c.id == row.campaign_id).values(timezone=zone))
    for key in connection.scalars(sa.select(_lineage.c.key)).all():
        document = connection.execute(sa.select(_lineage.c.document).where(_lineage.c.key == key)).scalar_one()
        if rows := _plugins(key, document):
            connection.execute(sa.insert(plugin), rows)
    connection.execute(sa.update(sa.table("schema_version", sa.column("version"))).values(version=2))


def _plugins(key: str, document: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        {
            "lineage_key": key,
            "role": role,
            "number": number,
            "name": identity["name"],
            "version": identity["version"],
            "parameters": identity.get("parameters", {}),
        }
        for node in document["nodes"].values()
        for role, given in node["plugins"].items()
        for number, identity in enumerate(given if isinstance(given, list) else [given])
    ]
