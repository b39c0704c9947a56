"""Tables of the catalog, for SQLite and PostgreSQL from one definition.

Times are integers, ns since 1970-01-01T00:00:00 UTC, because both databases hold those alike. What a query asks for
(time, quality, r0, scintillation) stands in the batch rows, so that no query opens a file.
"""

from __future__ import annotations

import sqlalchemy as sa

#: Version of the tables: the newest revision among the migrations.
SCHEMA_VERSION = 2

metadata = sa.MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)

schema_version = sa.Table("schema_version", metadata, sa.Column("version", sa.Integer, primary_key=True))

campaign = sa.Table(
    "campaign",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("name", sa.String(100), nullable=False, unique=True),
    # Name in the IANA database, as the newest of its archives gives it.
    sa.Column("timezone", sa.String(64)),
)

archive = sa.Table(
    "archive",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("campaign_id", sa.ForeignKey("campaign.id"), nullable=False, index=True),
    sa.Column("name", sa.String(100), nullable=False, index=True),
    sa.Column("identity", sa.String(64), nullable=False, unique=True),
    sa.Column("url", sa.Text, nullable=False),
    sa.Column("header", sa.JSON, nullable=False),
    sa.CheckConstraint("length(identity) = 64", name="identity"),
)

lineage = sa.Table(
    "lineage",
    metadata,
    sa.Column("key", sa.String(64), primary_key=True),
    sa.Column("stage", sa.String(100), nullable=False),
    sa.Column("document", sa.JSON, nullable=False),
    sa.CheckConstraint("length(key) = 64", name="key"),
)

#: Plugins that a lineage names, apart from its document so that they can be asked for.
plugin = sa.Table(
    "plugin",
    metadata,
    sa.Column("lineage_key", sa.ForeignKey("lineage.key", ondelete="CASCADE"), primary_key=True),
    sa.Column("role", sa.String(20), primary_key=True),
    sa.Column("number", sa.SmallInteger, primary_key=True, autoincrement=False),
    sa.Column("name", sa.String(100), nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("parameters", sa.JSON, nullable=False),
    sa.Index(None, "role", "name"),
)

run = sa.Table(
    "run",
    metadata,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("started", sa.BigInteger, nullable=False, index=True),
    sa.Column("finished", sa.BigInteger),
    sa.Column("state", sa.String(20), nullable=False),
    sa.Column("host", sa.Text, nullable=False),
    sa.Column("process", sa.Integer, nullable=False),
    sa.Column("command", sa.Text, nullable=False),
    sa.Column("commit", sa.Text, nullable=False),
    sa.Column("software", sa.JSON, nullable=False),
    sa.Column("configuration", sa.JSON, nullable=False),
    # When the run last said that it is alive.
    sa.Column("heartbeat", sa.BigInteger),
    # How far it was then, in its driver's words.
    sa.Column("progress", sa.JSON),
    sa.CheckConstraint("state in ('running', 'finished', 'failed', 'cancelled', 'interrupted')", name="state"),
)

product = sa.Table(
    "product",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("archive_id", sa.ForeignKey("archive.id"), nullable=False),
    sa.Column("lineage_key", sa.ForeignKey("lineage.key"), nullable=False, index=True),
    sa.Column("run_id", sa.ForeignKey("run.id"), index=True),
    sa.Column("path", sa.String(400), nullable=False, unique=True),
    sa.Column("sha256", sa.String(64), nullable=False),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("published", sa.BigInteger, nullable=False),
    sa.Column("start", sa.BigInteger, nullable=False, index=True),
    sa.Column("stop", sa.BigInteger, nullable=False),
    sa.Column("batches", sa.Integer, nullable=False),
    # When it was made the accepted product of its archive; of each archive one at most.
    sa.Column("accepted", sa.BigInteger),
    sa.UniqueConstraint("archive_id", "lineage_key"),
    sa.CheckConstraint("length(sha256) = 64", name="sha256"),
)
sa.Index(
    "uq_product_accepted",
    product.c.archive_id,
    unique=True,
    sqlite_where=product.c.accepted.is_not(None),
    postgresql_where=product.c.accepted.is_not(None),
)

batch = sa.Table(
    "batch",
    metadata,
    sa.Column("product_id", sa.ForeignKey("product.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("start", sa.BigInteger, nullable=False, index=True),
    sa.Column("stop", sa.BigInteger, nullable=False),
    sa.Column("quality_flag", sa.Integer, nullable=False),
    sa.Column("quality_level", sa.SmallInteger, nullable=False, index=True),
    sa.Column("n_frames", sa.BigInteger),
    sa.Column("r0", sa.Double, index=True),
    sa.Column("scintillation_index", sa.Double, index=True),
    sa.Column("scintillation_index_profile", sa.Double),
    sa.Column("scintillation_index_point", sa.Double),
    sa.Column("mu", sa.Double),
    sa.Column("chi2", sa.Double),
    sa.CheckConstraint("stop > start", name="time"),
    sa.CheckConstraint("quality_level between 0 and 2", name="quality_level"),
)

failure = sa.Table(
    "failure",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("run_id", sa.ForeignKey("run.id"), nullable=False, index=True),
    sa.Column("archive", sa.Text, nullable=False),
    sa.Column("start", sa.BigInteger),
    sa.Column("stop", sa.BigInteger),
    sa.Column("reason", sa.Text, nullable=False),
    sa.Column("recorded", sa.BigInteger, nullable=False),
)

#: Names of releases.
alias = sa.Table(
    "alias",
    metadata,
    sa.Column("name", sa.String(100), primary_key=True),
    sa.Column("created", sa.BigInteger, nullable=False),
    sa.Column("note", sa.Text, nullable=False),
)

#: Products of a release; none can go while a release names it.
alias_product = sa.Table(
    "alias_product",
    metadata,
    sa.Column("alias", sa.ForeignKey("alias.name", ondelete="CASCADE"), primary_key=True),
    sa.Column("product_id", sa.ForeignKey("product.id"), primary_key=True, index=True),
)
