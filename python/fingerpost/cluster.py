"""Distribution of work to the machines of a Dask cluster.

The task of a lost worker is repeated by another. A cluster is checked before any work begins: a
scheduler or worker that cannot import fingerpost would otherwise fail with obscure pickling errors.
Functions and results are pickled, so whoever reaches a scheduler can run anything on its machines:
bind it to loopback, or use TLS.
"""

from __future__ import annotations

import logging
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from importlib import metadata
from typing import TYPE_CHECKING, Any, TypeVar

from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.installation import require
from fingerpost.workers import held_back

if TYPE_CHECKING:
    from distributed import Client

Thing = TypeVar("Thing")

_LOCAL = "local"
_SCHEMES = ("tcp://", "tls://")
_ANSWERS_S = 10.0
_VERSION = "fingerpost:__version__"
_MOST_WORKERS = 1024


class Cluster:
    """A cluster that has passed the checks.

    Parameters
    ----------
    client
        A connected Dask client.
    """

    def __init__(self, client: Client) -> None:
        self._client = client

    def each(
        self, function: Callable[[Thing], Any], things: Sequence[Thing]
    ) -> Iterator[tuple[Thing, Any, str]]:
        """Call a function with each of several arguments on the cluster.

        Parameters
        ----------
        function
            A function of a module of fingerpost.
        things
            Its arguments; they must be picklable.

        Yields
        ------
        tuple
            In the order of completion: the argument, the return value, and the reason for a
            failure.

        Raises
        ------
        FingerpostError
            The scheduler was lost.
        """
        as_completed: Any = require("distributed", "cluster").as_completed
        waiting = {self._client.submit(function, thing, pure=False): thing for thing in things}
        completed = as_completed(waiting)
        for future in completed:
            if future.status == "lost":  # with its worker; another worker repeats the task
                completed.add(future)
                continue
            if future.status == "cancelled":
                raise FingerpostError("the scheduler is gone; what is done stays done")
            thing = waiting.pop(future)
            error = future.exception()
            yield (thing, future.result(), "") if error is None else (thing, None, _why(error))
            future.release()


def _why(error: BaseException) -> str:
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return "its worker process died, perhaps for want of memory"
    return " ".join(str(error).split()) or repr(error)


@contextmanager
def cluster_at(address: str) -> Iterator[Cluster]:
    """Connect to a cluster, or start one on this machine.

    Parameters
    ----------
    address
        Of its scheduler, `tcp://HOST:PORT` or `tls://HOST:PORT`; or `local:N` for N workers here.

    Raises
    ------
    InvalidInputError
        The address is invalid.
    FingerpostError
        Nobody answers there, there are no workers, or they fail the checks.
    MissingExtraError
        The extra `cluster` is not installed.
    """
    count = _local_count(address)
    distributed = require("distributed", "cluster")
    for name in ("distributed", "tornado"):  # their messages on single connections do not help
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        target: Any = address
        if count is not None:
            with held_back():
                target = stack.enter_context(
                    distributed.LocalCluster(
                        n_workers=count,
                        threads_per_worker=1,
                        host="127.0.0.1",
                        # Any free port: the scheduler listens for HTTP without a dashboard, too.
                        dashboard_address="127.0.0.1:0",
                        scheduler_kwargs={"dashboard": False},
                        silence_logs=logging.CRITICAL,
                    )
                )
        try:
            client = stack.enter_context(distributed.Client(target, timeout=_ANSWERS_S))
            _refuse_version("the scheduler", _version_of_scheduler(client), address)
            client.wait_for_workers(1, timeout=_ANSWERS_S)
        except TimeoutError as error:
            raise FingerpostError(
                f"--dask {address}: {_missing(str(error))} within {_ANSWERS_S:g} s"
            ) from error
        except OSError as error:
            raise FingerpostError(f"--dask {address}: no scheduler answers there") from error
        _refuse_workers(client, address)
        yield Cluster(client)


def _missing(said: str) -> str:
    return "no worker has come" if "workers" in said else "no scheduler answers there"


def _local_count(address: str) -> int | None:
    """Return the number of workers to start on this machine; None for an existing cluster."""
    word, _, number = address.partition(":")
    if word == _LOCAL and number.isdecimal() and 1 <= int(number) <= _MOST_WORKERS:
        return int(number)
    if not (address.startswith(_SCHEMES) and len(address) > len(_SCHEMES[0])):
        raise InvalidInputError(
            f"--dask {address}: tcp://HOST:PORT of a scheduler, or local:4 for four workers on "
            "this machine, is right"
        )
    return None


def _version_of_scheduler(client: Client) -> object:
    """Return a scheduler's version of fingerpost, or the reason for which it has none."""
    run_there: Any = client.run_on_scheduler
    try:
        return run_there(pkgutil.resolve_name, _VERSION)
    except Exception as error:  # an import may raise anything
        return error


def _refuse_version(place: str, version: object, address: str) -> None:
    """Refuse a scheduler or worker that lacks fingerpost or has another version of it.

    Raises
    ------
    FingerpostError
        It is refused.
    """
    here = metadata.version("fingerpost")
    if isinstance(version, BaseException):
        raise FingerpostError(
            f"--dask {address}: {place} cannot import fingerpost ({version}); install it there: "
            f"pip install 'fingerpost[cluster]=={here}'"
        )
    if version != here:
        raise FingerpostError(
            f"--dask {address}: {place} has fingerpost {version}, and here it is {here}; one "
            "version everywhere is right"
        )


def _refuse_workers(client: Client, address: str) -> None:
    """Refuse workers that lack fingerpost or have several threads.

    Raises
    ------
    FingerpostError
        The message names the first such worker.
    """
    versions = client.run(pkgutil.resolve_name, _VERSION, on_error="return")
    for worker, version in versions.items():
        _refuse_version(f"worker {worker}", version, address)
    workers: Mapping[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
    for worker, known in workers.items():
        if known["nthreads"] != 1:
            raise FingerpostError(
                f"--dask {address}: worker {worker} has {known['nthreads']} threads; start as many "
                "workers as there are cores, each with one: dask worker --nthreads 1 --nworkers -1"
            )
