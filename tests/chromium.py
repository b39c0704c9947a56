"""Chromium without a window, driven over WebDriver: what a page asked for, complained about, and shows."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

#: Script of axe-core; `.ci/tools` installs it and prints where it is.
AXE = os.environ.get("COSLIDAR_TEST_AXE")
#: Chromium asks for nothing by itself: what is seen on the network is the page's.
QUIET = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
    "--window-size=1200,900",
)  # fmt: skip


class Chromium:
    """One browser with a new profile in `folder`."""

    def __init__(self, folder: Path) -> None:
        programs = {name: shutil.which(name) for name in ("chromium", "chromedriver")}
        missing = [name for name, path in programs.items() if path is None]
        if missing:
            pytest.skip(f"no {' and no '.join(missing)}: pages are not opened in a browser; .ci/tools installs them")
        from selenium.webdriver import Chrome, ChromeOptions
        from selenium.webdriver.chrome.service import Service

        options = ChromeOptions()
        options.binary_location = str(programs["chromium"])
        for flag in (*QUIET, f"--user-data-dir={folder}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        self.driver = Chrome(options=options, service=Service(str(programs["chromedriver"])))
        self.driver.set_page_load_timeout(60)

    def close(self) -> None:
        """End the browser."""
        self.driver.quit()

    def open(self, address: str) -> None:
        """Show a page."""
        self.driver.get(address)

    def run(self, script: str, *arguments: Any) -> Any:
        """Value of a script, which the policy of the page does not hold back."""
        return self.driver.execute_script(script, *arguments)

    def complaints(self) -> list[str]:
        """What has been written to the console since the last call: errors, refused requests, violated policies."""
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def requests(self) -> list[str]:
        """Addresses that have been asked for since the last call, without those that are data themselves."""
        events = [json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")]
        sent = [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]
        return [address for address in sent if not address.startswith("data:")]

    def press(self, *keys: str) -> None:
        """Type with nothing but the keyboard, into whatever has the focus."""
        from selenium.webdriver import ActionChains

        ActionChains(self.driver, duration=0).send_keys(*keys).perform()

    def tab_to(self, script: str, most: int = 150) -> None:
        """Press Tab until the condition, with `e` for the element that has the focus, holds."""
        from selenium.webdriver import Keys

        for _ in range(most):
            self.press(Keys.TAB)
            if self.run(f"const e = document.activeElement; return {script};"):
                return
        raise AssertionError(f"{most} times Tab do not reach an element with {script}")

    def rows(self, table: str) -> list[list[str]]:
        """What the rows of a table are sorted by, as they stand."""
        return self.run(
            "return [...document.querySelector(arguments[0]).tBodies[0].rows].map(r => "
            "[...r.cells].map(c => c.dataset.v))",
            table,
        )

    def pictures(self, selectors: Iterable[str]) -> dict[str, np.ndarray]:
        """What is shown of the first visible element of each selector, (row, column, RGB); half a pixel for each."""
        from PIL import Image

        boxes = self.run(
            "return arguments[0].map(s => [...document.querySelectorAll(s)].find(e => e.checkVisibility()))"
            ".map(e => { const r = e.getBoundingClientRect(); return [r.left + scrollX, r.top + scrollY, "
            "r.right + scrollX, r.bottom + scrollY]; })",
            names := list(selectors),
        )
        size = self.run("const d = document.documentElement; return [d.scrollWidth, d.scrollHeight]")
        shot = self.driver.execute_cdp_cmd(
            "Page.captureScreenshot",
            {"format": "png", "captureBeyondViewport": True, "optimizeForSpeed": True,
             "clip": {"x": 0, "y": 0, "width": size[0], "height": size[1], "scale": 0.5}},
        )  # fmt: skip
        with Image.open(io.BytesIO(base64.b64decode(shot["data"]))) as image:
            return {
                name: np.asarray(image.convert("RGB").crop([round(edge / 2) for edge in box])).astype(int)
                for name, box in zip(names, boxes, strict=True)
            }

    def barriers(self) -> list[str]:
        """Serious and critical findings of axe-core on the page that is open, in the light and in the dark theme."""
        if not AXE:
            pytest.skip("COSLIDAR_TEST_AXE names no axe-core: accessibility is not checked; .ci/tools installs it")
        self.run(Path(AXE).read_text("utf-8"))
        found = []
        for theme in ("light", "dark"):
            features = [{"name": "prefers-color-scheme", "value": theme}]
            self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
            said = self.driver.execute_async_script(
                "const done = arguments[0]; axe.run({preload: false, resultTypes: ['violations']}).then("
                "r => done({passes: r.passes.length, violations: r.violations}), e => done({error: String(e)}))"
            )
            assert said.get("passes", 0) > 10, said
            found += [
                f"{theme}: {item['id']} ({item['impact']}): {item['help']}: {item['nodes'][0]['html'][:300]}"
                for item in said["violations"]
                if item["impact"] in ("serious", "critical")
            ]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
        return found
