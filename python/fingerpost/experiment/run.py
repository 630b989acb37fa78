"""Runs an experiment on all cores."""

from collections.abc import Callable, Iterator
from concurrent.futures import as_completed
from dataclasses import fields

from fingerpost.experiment.bench import Bench
from fingerpost.experiment.options import ExperimentOptions
from fingerpost.experiment.result import ExperimentResult
from fingerpost.experiment.trial import Trial
from fingerpost.workers import sharing, worker_count

Progress = Callable[[int, int], None]
"""Called with the number of completed targets and of all."""

# Targets per job of a worker: a second's work or less, so that progress is visible.
_CHUNK = 4


def run_experiment(
    options: ExperimentOptions | None = None,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> ExperimentResult:
    """Point at random targets and compare the results with the truth: section 3.3 of the paper.

    Parameters
    ----------
    options
        Options; default: the paper's rig with the default tracker.
    workers
        Number of processes, ≥ 1; 1 works in this process, None uses all cores. The result is the
        same to the last bit. More than one are started afresh ("spawn"), so a script needs the
        usual ``if __name__ == "__main__":``.
    progress
        Called in this process when targets are done: ``progress(done, targets)``.

    Returns
    -------
    ExperimentResult

    Raises
    ------
    InvalidInputError
        Options that contradict each other, that the tracker refuses, or under which no pose is well
        visible in all cameras.
    FingerpostError
        A worker died.
    """
    options = options or ExperimentOptions()
    workers = worker_count(workers)
    bench = Bench(options)  # refuses invalid options before any process is started
    trials: list[Trial] = []
    chunks = _inline(bench, options) if workers == 1 else _shared_out(options, workers)
    for chunk in chunks:
        trials += chunk
        if progress is not None:
            progress(len(trials), options.targets)
    trials.sort(key=lambda trial: trial.index)
    return ExperimentResult(
        title=_title(options),
        settings={field.name: getattr(options, field.name) for field in fields(options)},
        unit="mm",
        plane_size=bench.plane_size,
        plane_points=options.workspace.points_mm,
        trials=tuple(trials),
    )


def _inline(bench: Bench, options: ExperimentOptions) -> Iterator[list[Trial]]:
    for index in range(options.targets):
        yield [bench.trial(index)]


def _shared_out(options: ExperimentOptions, workers: int) -> Iterator[list[Trial]]:
    starts = range(0, options.targets, _CHUNK)
    with sharing(min(workers, len(starts)), _start_worker, options) as pool:
        futures = [
            pool.submit(_work, range(start, min(start + _CHUNK, options.targets)))
            for start in starts
        ]
        for future in as_completed(futures):
            yield future.result()


# The worker's own bench: the table of a cluttered scene takes longer to draw than many trials.
_bench: Bench | None = None


def _start_worker(options: ExperimentOptions) -> None:
    global _bench
    _bench = Bench(options)


def _work(indices: range) -> list[Trial]:
    assert _bench is not None, "the worker was not started"
    return [_bench.trial(index) for index in indices]


def _title(options: ExperimentOptions) -> tuple[str, ...]:
    cameras, lighting, sensor = options.cameras, options.lighting, options.sensor
    tracker = ", ".join(f"{key} {value}" for key, value in options.tracker.items()) or "defaults"
    conditions = [
        f"{cameras.width_px} × {cameras.height_px} px",
        f"contrast {lighting.contrast:g}",
        f"noise {sensor.noise:g}",
        f"blur {sensor.blur_px:g} px",
        f"taper {100 * options.taper:g} %",
        f"references ± {options.reference_noise_px:g} px",
    ]
    if lighting.side_light:
        conditions.append(f"side light {100 * lighting.side_light:g} %")
    if lighting.limb_darkening:
        conditions.append(f"limb darkening {100 * lighting.limb_darkening:g} %")
    if options.background.clutter:
        conditions.append(f"clutter ± {options.background.clutter:g}")
    if options.background_frames:
        conditions.append(f"{options.background_frames} pictures of the table first")
    if options.approach_frames:
        conditions.append(f"started elsewhere, {options.approach_frames} pictures away")
    if any(cameras.k1):
        conditions.append(f"k1 {', '.join(f'{k1:g}' for k1 in cameras.k1)}, {options.lens}")
    return (
        f"{options.targets} targets, {options.device}, tracker: {tracker}; seed {options.seed}",
        ", ".join(conditions),
    )
