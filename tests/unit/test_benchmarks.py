"""Every benchmark runs, on sizes at which its figures mean nothing."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """A benchmark by its name, as its command would load it."""
    monkeypatch.syspath_prepend(str(FOLDER))

    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
        return module

    return load


def test_extraction(benchmark: Any, capsys: pytest.CaptureFixture[str]) -> None:
    bench = benchmark("bench_extraction")
    result = bench.main(["--frames", "16", "--repeats", "2"])
    assert result.sum > 0
    # A hundred times in truth: no machine is so busy that it would hide this.
    assert all(cost > result.kernel for cost in result.others.values())
    printed = capsys.readouterr().out
    assert all(peer in printed for peer in bench.PEERS)
    assert printed.splitlines()[-1].startswith("kernel / np.sum")


def test_a_missing_peer_is_told(benchmark: Any, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    bench = benchmark("bench_extraction")
    result = bench.Result(1e-5, 1e-5, {"scipy.ndimage": 1e-3})
    monkeypatch.setattr(bench, "measure", lambda frames, repeats: result)
    bench.main([])
    assert "AOtools                 skipped: not installed" in capsys.readouterr().out


def test_chain(benchmark: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench = benchmark("bench_chain")
    times = bench.main(["--frames", "96", "--codec", "lz4", "zstd", "--repeat", "1", "--threads", "1"], folder=tmp_path)
    assert len(times) == 2
    printed = capsys.readouterr().out
    # What is spent where adds up to the whole, and every part is met.
    lines = [line for line in printed.splitlines() if line.startswith("  ")]
    assert len(lines) == 2 * (len(bench.PARTS) + 2)
    idle = [line for line in lines if line.split(" ms")[0].split()[-1] == "0"]
    assert len(idle) <= len(bench.PARTS) / 2, idle
    assert "chain / reading" in printed.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bench_response", "bench_band"])
def test_responses(benchmark: Any, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    benchmark(name).main()
    assert capsys.readouterr().out


@pytest.mark.slow
def test_methods(benchmark: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["bench_methods", "--frames", "70", "--drawn", "20"])
    bench = benchmark("bench_methods")
    bench.main()
    bench.test_the_default_answers_with_gain_one()
    assert capsys.readouterr().out


@pytest.mark.slow
def test_catalog(benchmark: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["bench_catalog", "--rows", "400", "--repeats", "2", "--database", "sqlite"])
    benchmark("bench_catalog").main()
    assert capsys.readouterr().out
