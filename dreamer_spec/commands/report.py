"""`train report`: one HTML page about one run or many."""

from collections.abc import Sequence
from pathlib import Path

from dreamer_spec.cli import Parser
from dreamer_spec.disk.files import require_place
from dreamer_spec.errors import writing
from dreamer_spec.report import page
from dreamer_spec.report.runs import find_logdirs, read_run
from dreamer_spec.words import counted

DESCRIPTION = """One HTML page about one run or many, which needs no network: results, curves, predictions,
configuration, machine, and the command that gives the same run again. Runs that differ in their seed
alone are drawn as one, with their spread. Runs may still be going on."""


def main(arguments: Sequence[str]) -> int:
    """Writes the page.

    Raises:
      UserError: no run, or a page that cannot be written.
    """
    parser = Parser(prog="train report", description=DESCRIPTION, allow_abbrev=False)
    parser.add_argument(
        "logdirs", type=Path, nargs="+", metavar="LOGDIR", help="log directory of a run, or a directory that holds some"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("report.html"), metavar="FILE", help="the page (default report.html)"
    )
    options = parser.parse_args(arguments)
    remedy = "; choose another file with --out"
    with writing(options.out, remedy):
        require_place(options.out)
    runs = [read_run(logdir) for logdir in find_logdirs(options.logdirs)]
    size = page.write(options.out, runs, remedy)
    print(f"{options.out}: {counted(len(runs), 'run')}, {size / 1000:,.0f} kB")
    return 0
