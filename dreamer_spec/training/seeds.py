"""`train --seeds 0-4`: runs that differ in their seed alone, one after the other, each in a log directory of its own.
[LOOP-73]"""

import traceback
from collections.abc import Callable, Sequence

from conformance.errors import say_error
from dreamer_spec.disk.about import read_about
from dreamer_spec.errors import UserError
from dreamer_spec.monitoring.outcome import last_words, read_outcome, summary
from dreamer_spec.options import Options


def run_all(runs: Sequence[Options], run: Callable[[Options], bool], say: Callable[[str], None] = print) -> int:
    """Trains, or continues, one run after the other, and says what came of all. Returns the exit code: 2 if one failed,
    130 after Ctrl-C.

    A run that fails is named, and the next one begins: the others are not lost. But what keeps the first one from
    beginning at all, such as an unknown task, would keep them all.

    Raises:
      UserError: the first run could not begin.
    """
    ended: list[Options] = []
    failed: list[Options] = []
    interrupted: Options | None = None
    for number, options in enumerate(runs):
        say(f"seed {options.seed} ({number + 1} of {len(runs)})")
        try:
            done = run(options)
        except UserError as error:
            if number == 0 and read_about(options.logdir) is None:
                raise
            say_error("train", error, f"seed {options.seed}: ")
            failed.append(options)
            continue
        except Exception:  # Not ours to know; the other seeds are not to be lost by it.
            traceback.print_exc()
            failed.append(options)
            continue
        if not done:
            interrupted = options
            break
        ended.append(options)
    outcomes = {options.seed: read_outcome(options.logdir) for options in ended}
    for options in ended:
        say(f"seed {options.seed}: {last_words(outcomes[options.seed], None)}; {options.logdir}")
    for options in failed:
        say(f"seed {options.seed} failed; {options.logdir}")
    if interrupted:
        say(f"interrupted in seed {interrupted.seed}; the same command continues from there")
    if ended:
        say(summary(outcomes))
    return 130 if interrupted else 2 if failed else 0
