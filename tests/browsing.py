"""A catalog to browse, and the page of `coslidar browse` with a client that knows its token."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import httpx
import made_products

from coslidar.catalog.store import Catalog

HOSTILE_NAME = "evening.2"
HOSTILE = '"><script>alert(1)</script>'


def hostile_catalog(root: Path) -> Path:
    """A catalog: one archive under two lineages, and one whose header and run are hostile."""
    with Catalog(root) as catalog:
        run = catalog.start_run(command=f"coslidar run {HOSTILE}")
        catalog.publish(made_products.product(1), run)
        catalog.publish(made_products.product(2, attributes={"sampling": "midpoint"}), run)
        other = made_products.product(
            3, archive=HOSTILE_NAME, archive_identity="f" * 64, sources=[HOSTILE, "top"], attributes={"site": HOSTILE}
        )
        catalog.publish(other, run, header={"name": HOSTILE})
        catalog.record_failure(run, HOSTILE, f"no light in {HOSTILE}")
        catalog.finish_run(run)
    return root


class Server:
    """A running page and a client that knows its token."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        said = ""
        while "token=" not in said:
            line = process.stdout.readline()  # type: ignore[union-attr]
            assert line, f"the server ended: {process.stderr.read()}"  # type: ignore[union-attr]
            said += line
        self.address = re.search(r"http://\S+", said)[0]  # type: ignore[index]
        self.base, self.token = self.address.split("/?token=")
        self.client = httpx.Client(
            base_url=self.base, headers={"authorization": f"Bearer {self.token}"}, timeout=60, trust_env=False
        )

    def page(self, path: str, status: int = 200) -> str:
        answer = self.client.get(path)
        assert answer.status_code == status, f"{path}: {answer.status_code}\n{answer.text[:500]}"
        return answer.text
