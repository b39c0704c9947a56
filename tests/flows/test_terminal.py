"""What people see: at a terminal, in a log, and when something is not there."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections.abc import Callable
from pathlib import Path

import pytest
from small_runs import Finished, command, environment, products, run_arguments

Main = Callable[..., Finished]


def at_a_terminal(arguments: list[object], cache: Path, folder: Path) -> tuple[int, str]:
    """Run the program with a terminal of 100 columns for stderr and stdout."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 100, 0, 0))
    process = subprocess.Popen(
        command(*arguments),
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        cwd=folder,
        env=environment(cache, TERM="xterm-256color"),
        start_new_session=True,
    )
    os.close(theirs)
    parts = []
    while True:
        try:
            data = os.read(ours, 65536)
        except OSError:  # the terminal has closed
            break
        if not data:
            break
        parts.append(data)
    os.close(ours)
    return process.wait(30), b"".join(parts).decode()


def test_a_terminal_shows_bars(recordings: list[str], cache: Path, tmp_path: Path) -> None:
    code, shown = at_a_terminal(run_arguments(recordings[:2], tmp_path / "out"), cache, tmp_path)
    assert code == 0, shown
    assert "\x1b[" in shown
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)
    assert re.search(r"archives\s.*0/2", plain)
    assert re.search(r"demo/r0\s.*/4", plain)
    lines = [line.strip() for line in re.split(r"[\r\n]+", plain)]
    assert any(line.endswith("demo/r0: 4 batches published") for line in lines)
    assert "2 of 2 archives are in" in plain
    # The cursor is given back.
    assert shown.rfind("\x1b[?25h") > shown.rfind("\x1b[?25l")


def test_a_log_has_one_line_per_archive(main_here: Main, recordings: list[str], tmp_path: Path) -> None:
    done = main_here(*run_arguments(recordings[:1], tmp_path / "out"))
    assert done.code == 0
    assert "\x1b" not in done.err + done.out
    first, last = done.err.splitlines()
    assert first == "coslidar: [1/1] demo/r0: 4 batches published"
    assert re.fullmatch(r"coslidar: 4 batches computed, 852 frames read, \d+\.\d s", last)
    product = next((tmp_path / "out" / "products" / "demo").iterdir())
    assert done.out.splitlines() == [
        f"1 of 1 archive is in {tmp_path / 'out'}",
        f"Next: coslidar report {product} -o report.html",
    ]
    again = main_here(*run_arguments(recordings[:1], tmp_path / "out"))
    assert again.err.splitlines()[0] == "coslidar: [1/1] demo/r0: 4 batches, in the catalog already"
    assert again.err.splitlines()[1].startswith("coslidar: 0 batches computed, 0 frames read")
    quiet = main_here(*run_arguments(recordings[:1], tmp_path / "out", "--quiet"))
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")


def test_the_catalog_tells_of_runs_and_failures(main_here: Main, recordings: list[str], tmp_path: Path) -> None:
    assert main_here(*run_arguments([*recordings[:1], str(tmp_path / "absent.zarr")], tmp_path / "out")).code == 2
    listed = main_here("catalog", "runs", "--out", tmp_path / "out", "--failures").out.splitlines()
    assert len(listed) == 3
    assert re.match(r"20\d\d-\S+Z +failed +1  coslidar run ", listed[1])
    assert listed[2] == f"    {tmp_path / 'absent.zarr'}: there is no such file or folder; check the path"


def test_plan_says_what_a_run_will_do(main_here: Main, recordings: list[str], tmp_path: Path) -> None:
    arguments = run_arguments(recordings[:1], tmp_path / "out")[:-1]
    plan = ["plan", *arguments[1:]]
    before = main_here(*plan)
    assert before.code == 0
    assert re.fullmatch(
        r"demo/r0: 4 batches to compute; 852 frames to read, \d+ kB to write  \(key [0-9a-f]{16}\)\n"
        r"in all 4 batches to compute, 852 frames to read, \d+ kB to write\n"
        r"about \d+ s on \d+ threads?, no earlier run in this catalog tells .*\n",
        before.out,
    )
    assert not (tmp_path / "out").exists()
    assert main_here(*arguments, "--no-prefect").code == 0
    after = main_here(*plan)
    assert after.out == ("demo/r0: 4 batches, in the catalog already\nin all 0 batches to compute, 0 frames to read\n")
    other = main_here(*plan, "--sampling", "midpoint", "--slices", "5")
    assert "4 batches to compute, 4 from kept correlations; 0 frames to read" in other.out


def test_options_and_settings_are_the_same(main_here: Main, recordings: list[str], tmp_path: Path) -> None:
    base = ["run", recordings[0], "--no-prefect", "--set", "batch.duration=6 s"]
    done = main_here(*base, "--out", tmp_path / "a", "--slices", "5", "--sampling", "midpoint")
    assert done.code == 0, done.err
    sets = ["--set", "response.slices=5", "--set", "response.sampling=midpoint"]
    done = main_here(*base, "--out", tmp_path / "b", *sets)
    assert done.code == 0, done.err
    path = tmp_path / "campaign.toml"
    path.write_text(
        f"archives = ['{recordings[0]}']\n[batch]\nduration = '6 s'\n[response]\nslices = 5\nsampling = 'midpoint'\n"
    )
    done = main_here("run", path, "--no-prefect")
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1] == f"Next: coslidar report {path} -o report.html"
    assert products(tmp_path / "a") == products(tmp_path / "b") == products(tmp_path / "results")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["catalog", "ls", "--out", "nowhere"], ["nowhere", "there is no catalog", "coslidar run"]),
        (["catalog", "verify", "--out", "nowhere"], ["nowhere", "there is no catalog", "coslidar run"]),
        (["catalog", "show", "x", "--out", "nowhere"], ["nowhere", "there is no catalog", "coslidar run"]),
        (["catalog", "ls", "--out", "."], ["there is no catalog", "coslidar run"]),
        (["report", "nowhere.toml", "-o", "r.html"], ["nowhere.toml", "cannot be read", "coslidar init"]),
        (["report", ".", "-o", "r.html"], ["there is no catalog", "coslidar run"]),
        (["report", "some-product", "-o", "r.html", "--out", "nowhere"], ["nowhere", "there is no catalog"]),
        (["run", "nowhere.toml"], ["nowhere.toml", "cannot be read", "coslidar init"]),
        (["run", "x.zarr", "--set", "batch.duration=3"], ["batch.duration", "the unit is missing", "'3 s'"]),
        (["run", "x.zarr", "--set", "batch.length=3 s"], ["batch.length", "there is no such key"]),
        (["run", "x.zarr", "--set", "regulariser=tv"], ["regulariser.name", "'tv'", "white"]),
        (["plan", "*.zarr"], ["*.zarr", "no file or folder matches"]),
        (["inspect", "nowhere.zarr"], ["nowhere.zarr", "there is no such file"]),
    ],
)
def test_what_is_not_there_is_one_line(main_here: Main, arguments: list[str], words: list[str], tmp_path: Path) -> None:
    done = main_here(*arguments)
    assert done.code == 2, done.err
    assert done.out == ""
    (line,) = done.err.splitlines()
    assert line.startswith("coslidar: ")
    for word in words:
        assert word in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [["run"], ["report"], ["frobnicate"], ["run", "a", "--frob"], ["catalog", "nix"]])
def test_wrong_usage(main_here: Main, arguments: list[str]) -> None:
    done = main_here(*arguments)
    assert done.code == 2
    assert "Usage: coslidar" in done.err
    assert "Error: " in done.err
    assert "--help" in done.err


COMMANDS = [
    ["init"], ["inspect"], ["simulate"], ["plan"], ["run"], ["report"], ["catalog"], ["plugins"], ["response"],
    ["invert"], ["catalog", "ls"], ["catalog", "show"], ["export"], ["catalog", "verify"],
    ["catalog", "gc"], ["catalog", "runs"], ["plugins", "ls"], ["plugins", "describe"],
]  # fmt: skip


@pytest.mark.parametrize("names", COMMANDS, ids=" ".join)
def test_help_teaches(main_here: Main, names: list[str]) -> None:
    done = main_here(*names, "--help")
    assert (done.code, done.err) == (0, "")
    assert f"Usage: coslidar {' '.join(names)}" in done.out
    # Every option says what it does.
    options = done.out.partition("Options:")[2]
    for name, words in re.findall(r"^  (-[^\n]*?)(?:  +(\S[^\n]*))?\n(?=  \S|$)", options, re.MULTILINE):
        assert words or "\n" in name, (names, name)
    body = done.out.partition("\n")[2].partition("Options:")[0].strip()
    assert len(body) > 20


def test_the_first_page_names_every_command_and_the_exit_codes(main_here: Main) -> None:
    done = main_here("--help")
    assert done.code == 0
    for name in ("init", "inspect", "simulate", "plan", "run", "report", "catalog", "plugins", "response", "invert"):
        assert re.search(rf"^  {name} +\S", done.out, re.MULTILINE)
    assert "Exit codes: 0 all done" in done.out
    assert "First steps" in done.out


def test_a_broken_pipe_is_silent(recordings: list[str], cache: Path, tmp_path: Path) -> None:
    """Whoever reads our output may go: of what we print, and of what we say about a run."""
    script = 'trap "" PIPE; "$@" 2>err | true; exit "${PIPESTATUS[0]}"'
    shell = ["bash", "-c", script, "bash"]
    for arguments in (["plugins", "ls"], ["--help"], ["plan", recordings[0], "--slices", "3"]):
        done = subprocess.run(
            [*shell, *command(*arguments)], capture_output=True, cwd=tmp_path, env=environment(cache), timeout=60
        )
        assert (done.returncode, (tmp_path / "err").read_text()) == (0, ""), arguments
    script = '"$@" 2>&1 >out | true; exit "${PIPESTATUS[0]}"'
    done = subprocess.run(
        ["bash", "-c", script, "bash", *command(*run_arguments(recordings[:1], tmp_path / "out-folder"))],
        capture_output=True,
        cwd=tmp_path,
        env=environment(cache),
        timeout=120,
    )
    assert done.returncode == 0
    assert len(products(tmp_path / "out-folder")) == 1


def test_help_costs_little(cache: Path) -> None:
    """Nothing heavy is imported for a page of text."""
    heavy = ("dask", "distributed", "prefect", "zarr", "xarray", "sqlalchemy", "matplotlib", "numba", "scipy", "pint")
    script = (
        "import sys; sys.argv = ['coslidar', '--help']\n"
        "from coslidar.flows.cli import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        f"sys.exit(','.join(name for name in {heavy!r} if name in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment(cache))
    assert done.stderr.strip() == ""
