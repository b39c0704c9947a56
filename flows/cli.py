"""The command line. Every command imports what it needs when it runs, so that `--help` is instant."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
from typing import TYPE_CHECKING, Any, NoReturn

import click

if TYPE_CHECKING:
    from collections.abc import Sequence

#: Command -> (module with it, line for the list of commands), in the order of use.
COMMANDS = {
    "init": ("start", "Write a campaign file to begin with, or a whole simulated example."),
    "inspect": ("start", "Show what a raw archive holds, and every fault it has."),
    "ingest": ("ingest", "Make a raw archive of FITS, HDF5, NumPy, TIFF or raw binary files."),
    "simulate": ("start", "Make recordings whose truth is known."),
    "plan": ("process", "Show what a run would read, compute and reuse."),
    "run": ("process", "Turn recordings into catalogued Cn2 profiles."),
    "serve": ("deploy", "Process campaigns again and again, as new archives come."),
    "deploy": ("deploy", "Register campaigns with a Prefect server and its workers."),
    "status": ("status", "Show how far runs are, what failed in them, and how to continue."),
    "show": ("reproduce", "Print a product's lineage as the campaign file that makes it again."),
    "compare": ("agreement", "Compare profiles with scintillometers on the same path."),
    "link": ("link", "Tell what profiles mean for an optical link: r0, isoplanatic angle, coherence time, Rytov."),
    "report": ("report", "Draw one self-contained page of a campaign or product."),
    "export": ("export", "Write products as CSV, NetCDF or Parquet, slopes and fluxes as AOT telemetry."),
    "browse": ("browse", "Look through a catalog in a web browser."),
    "catalog": ("catalog", "List, find, compare, cite and keep products."),
    "plugins": ("science", "List, describe and check installed plugins."),
    "response": ("science", "Compute the response matrix M of an instrument."),
    "invert": ("science", "Invert correlation data of your own with a response matrix."),
    "experiment": ("experiment", "Try priors, selectors and error bars on data whose truth is known."),
}


class Commands(click.Group):
    """Commands that are imported only when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """In the order of use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f".commands.{COMMANDS[cmd_name][0]}", __package__)
        command: click.Command = getattr(module, cmd_name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands without importing any."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])


@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="First steps:  coslidar init demo --scenario demo;  coslidar run demo/campaign.toml;  "
    "coslidar report demo/campaign.toml -o report.html",
)
@click.version_option(package_name="coslidar")
def cli() -> None:
    """Cn2 profiles along the line of sight from Shack-Hartmann recordings of two distant sources.

    Raw archives (zarr, format 1) go in; catalogued profiles with error bars, units and lineage come out.
    Quantities are written with their unit: "7 cm", "3 min", "1e27 m^(4/3)".

    Exit codes: 0 all done, 1 something failed, 2 an input cannot be used, 130 interrupted.
    """


def complain(faults: Sequence[str]) -> None:
    """Print one line per fault on stderr."""
    for fault in faults:
        click.echo(f"coslidar: {fault}", err=True)


#: Set once a signal has asked this process to end.
interrupted = threading.Event()


def _stop(signum: int, frame: Any) -> NoReturn:
    interrupted.set()
    # Once is a request, twice an order.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(130))
    raise KeyboardInterrupt


def main() -> None:
    """Run the command line; no traceback reaches the user unless COSLIDAR_DEBUG is set."""
    # One thread for each numerical library, before any is imported: the batches are what runs in parallel.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup and shells in the background want it
            signal.signal(number, _stop)
    try:
        if "_COSLIDAR_COMPLETE" in os.environ:
            cli.main(prog_name="coslidar")  # completion in the shell
        # Not cli.main: how a program ends is told below, and nowhere else.
        with cli.make_context("coslidar", sys.argv[1:]) as context:
            sys.exit(cli.invoke(context) or 0)
    except click.exceptions.Exit as leave:
        sys.exit(leave.exit_code)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        if sys.stderr.isatty():
            click.echo(err=True)  # the terminal has written ^C into this line
        complain(["interrupted; what was finished is kept, the same command goes on from there"])
        # All is closed; threads of libraries are not worth waiting for.
        os._exit(130)
    except BrokenPipeError:
        # The reader of our output (head, less) has gone; that is its good right.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except Exception as error:
        faults = getattr(error, "faults", None)
        if isinstance(faults, list):
            complain(faults)
            sys.exit(2)
        if os.environ.get("COSLIDAR_DEBUG"):
            raise
        from ..pipeline.units import safe
        from .settings import Unavailable

        if isinstance(error, Unavailable):
            complain([safe(str(error))])
            sys.exit(1)
        complain(
            [
                f"{type(error).__name__}: {safe(str(error))}",
                "this is not your input's fault, or we failed to say so; COSLIDAR_DEBUG=1 shows where it happened",
            ]
        )
        sys.exit(1)
