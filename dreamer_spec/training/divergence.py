"""Numbers that are not finite: noticed, saved for inspection, and the end of the run, or skipped. [LOOP-12], [LOOP-40]
to [LOOP-44]"""

import numpy as np

from dreamer_spec.disk import checkpoint
from dreamer_spec.disk.incidents import save_incident, stop_error
from dreamer_spec.errors import UserError
from dreamer_spec.training.state import TrainingRun


def settle(run: TrainingRun) -> None:
    """Looks at the metrics of the newest train step, which must be computed or will be waited for.

    Raises:
      UserError: a loss or the gradient is not finite, and the run does not skip such updates. What is needed to find
        out why is saved.
    """
    step, run.unsettled = run.unsettled, None
    if step is None:
        return
    metrics = {name: float(value) for name, value in step.metrics.items()}
    if not metrics["skipped"]:
        run.means.add(metrics)
    elif run.options.nonfinite == "skip":
        run.means.add({"skipped": 1.0})
    else:
        info = {
            "train_step": step.number,
            "step": run.step,
            "backend": run.options.backend,
            "identity": run.options.identity(),
            "spaces": run.envs.spaces.to_json(),
            "metrics": metrics,
        }
        raise stop_error(save_incident(run.options.logdir, run.learner, step.batch, step.seed, info), info)


def mean_metrics(run: TrainingRun) -> dict[str, float]:
    """Means over the train steps since the last call, under `train/`."""
    settle(run)
    return {f"train/{name}": value for name, value in run.means.take().items()}


def diverged(run: TrainingRun, what: str) -> UserError:
    saved = (
        f"the checkpoint in {run.options.logdir} is from before; " if checkpoint.candidates(run.options.logdir) else ""
    )
    return UserError(
        f"training diverged: {what} is not finite at train step {run.counters.train_steps} (step {run.step}); "
        f"{saved}try a smaller --learning-rate or another --compute-dtype, with a --logdir of its own"
    )


def finite_action(run: TrainingRun, action: np.ndarray) -> np.ndarray:
    """The policy's action in float32. [LOOP-12]

    Raises:
      UserError: a number is not finite.
    """
    action = np.array(action, np.float32)
    if not np.isfinite(action).all():
        raise diverged(run, "the policy's action")
    return action
