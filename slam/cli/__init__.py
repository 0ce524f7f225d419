"""The command line: thin; what a command needs is imported when it runs."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from typing import Annotated

import typer
from typer import Option

from slam.cli._output import be_quiet, visible
from slam.cli.clouds import fit, register
from slam.cli.joining import fleet, join
from slam.cli.results import evaluate, explain, export, import_, view
from slam.cli.runs import demo, map_, simulate, slam
from spplanes._version import __version__

app = typer.Typer(
    name="spplanes",
    help="Planes with honest covariances, and plane-based SLAM on GTSAM.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # boxes round help and refusals took 0.2 s of importing
    context_settings={"help_option_names": ["-h", "--help"]},
)

#: Options of the group that may come after the command too.
_OF_GROUP = ("-v", "-vv", "--verbose", "-q", "--quiet")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: 0 done, 2 bad input or usage in one sentence on stderr, 1 anything else."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        app(args=_group_first(sys.argv[1:] if arguments is None else arguments), prog_name="spplanes")
    except (ValueError, ImportError) as error:  # an ImportError says which extra to install
        _fail(error, 2)
    except KeyboardInterrupt:
        _fail("stopped", 1)
    except SystemExit as end:
        if end.code == 130:  # what click makes of Ctrl-C
            _fail("stopped", 1)
        raise
    except OSError as error:  # a full disk is nobody's bad input, and nothing unexpected
        _fail(f"{error.filename or 'a file'}: {error.strerror}" if error.strerror else error, 1)
    except Exception as error:  # the boundary: whatever it is, no traceback
        if isinstance(error.__cause__ or error.__context__, KeyboardInterrupt):  # a kernel was running at Ctrl-C
            _fail("stopped", 1)
        _fail(f"unexpected {type(error).__name__}: {error}", 1)


def _group_first(arguments: Sequence[str]) -> list[str]:
    """The arguments with -v and -q before the command, wherever they were given: no command has such options."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    own = [argument for argument in arguments[:end] if argument in _OF_GROUP]
    return [*own, *(argument for argument in arguments[:end] if argument not in _OF_GROUP), *arguments[end:]]


def _fail(error: object, code: int) -> None:
    sentence = " ".join(str(error).split())
    print(f"spplanes: {visible(sentence)}", file=sys.stderr)
    sys.exit(code)


@app.callback(invoke_without_command=True)
def group(
    context: typer.Context,
    version: Annotated[bool, Option("--version", help="Print the version; with -v of the data formats too.")] = False,
    verbose: Annotated[int, Option("-v", "--verbose", count=True, help="Say more; twice: all there is.")] = 0,
    quiet: Annotated[bool, Option("-q", "--quiet", help="Results, warnings and errors alone.")] = False,
) -> None:
    """Planes with honest covariances, and plane-based SLAM on GTSAM."""
    if verbose and quiet:
        raise typer.BadParameter("expected one of -v and -q, got both", param_hint="-q")
    logging.getLogger().setLevel((logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)])
    be_quiet(quiet)
    if version:
        typer.echo(f"spplanes {__version__}")
        if verbose:
            from slam.io.planes_json import FORMAT
            from slam.session._file import VERSION

            typer.echo(f"session.db: version {VERSION}\nplanes.json: {FORMAT}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        raise typer.BadParameter("expected a command, got none; -h lists them", param_hint="spplanes")


for _command in (fit, slam, demo, simulate, evaluate, explain, export, view, map_, import_, register, join, fleet):
    app.command(name=_command.__name__.rstrip("_"))(_command)
