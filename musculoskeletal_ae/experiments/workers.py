# SPDX-License-Identifier: Apache-2.0
"""Workers run independent calls in parallel: processes of this machine, or of a Dask cluster.

Each call runs with one thread of the numeric libraries, because further threads would compete with
the other processes. The results do not depend on the number of workers or on where they run.

A worker may be killed, for example for lack of memory. Its call then runs again. If that fails
repeatedly, the result of the call is a WorkerKilledError, and the other calls continue.
"""

import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

import torch
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.process_signals import interrupts_blocked

Call = tuple[Any, ...]  # the arguments of a function
PATIENCE = 10  # refuse a scheduler that does not answer within this time [s]


class WorkerKilledError(MusculoskeletalError):
    """A worker process was killed at each attempt at a call."""

    def __init__(self) -> None:
        super().__init__(
            'the worker process was killed at each attempt, for example for lack of memory; use '
            'fewer processes on each machine, or machines with more memory'
        )


class Workers(ABC):
    """Processes that run calls of a function in parallel."""

    @abstractmethod
    def as_they_end(
        self, function: Callable[..., Any], calls: Sequence[Call]
    ) -> Iterator[tuple[int, Any]]:
        """Yield the index in `calls` and the result of each call as soon as it has ended.

        Args:
            function: A function of a module that the workers can import. An error that it raises
                ends all calls.
            calls: The arguments of each call.
        """

    def in_order(self, function: Callable[..., Any], calls: Sequence[Call]) -> Iterator[Any]:
        """Yield the results in the order of the calls, each as soon as possible.

        Raises:
            WorkerKilledError: If the worker of a call was killed repeatedly.
        """
        results = dict[int, Any]()
        following = 0
        for index, result in self.as_they_end(function, calls):
            if isinstance(result, WorkerKilledError):
                raise result
            results[index] = result
            while following in results:
                yield results.pop(following)
                following += 1


@contextmanager
def workers(jobs: int, scheduler: str | None) -> Iterator[Workers]:
    """Yield the workers that the options `--jobs` and `--scheduler` name.

    Args:
        jobs: Number of processes on this machine.
        scheduler: Address of the scheduler of a Dask cluster to use instead, or None.

    Raises:
        MusculoskeletalError: If the cluster cannot be reached.
    """
    if scheduler is None:
        yield _Processes(jobs)
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise MusculoskeletalError(
            f'--scheduler {scheduler} needs Dask; install it here and on the workers with: '
            'pip install "dask[distributed]"'
        ) from error
    try:
        client = Client(scheduler, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise MusculoskeletalError(
            f'--scheduler {scheduler}: no Dask scheduler answers ({error}); expected the address '
            'that `dask scheduler` prints, such as tcp://192.168.0.2:8786'
        ) from error
    with client:
        yield _Cluster(client)


class _Processes(Workers):
    """Processes of this machine, by joblib; a single job runs in the process of the caller."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs

    def as_they_end(
        self, function: Callable[..., Any], calls: Sequence[Call]
    ) -> Iterator[tuple[int, Any]]:
        """Yield the index and the result of each call as soon as it has ended."""
        return self._run(function, dict(enumerate(calls)), is_first=True)

    def _run(
        self, function: Callable[..., Any], calls: Mapping[int, Call], is_first: bool
    ) -> Iterator[tuple[int, Any]]:
        """Run a function with the arguments in `calls`, and yield results with the keys of `calls`.

        If one worker is killed, joblib ends all of them. The halves of the remaining calls then run
        one after the other, until a call is alone. A lone call runs again if `is_first` says that
        this was its first attempt alone; otherwise, its result is a WorkerKilledError.
        """
        missing = dict(calls)
        try:
            for index, result in self._run_once(function, calls):
                del missing[index]
                yield index, result
            return
        except BrokenProcessPool:
            left = [*missing.items()]
        if len(left) > 1:
            half = len(left) // 2
            yield from self._run(function, dict(left[:half]), is_first=True)
            yield from self._run(function, dict(left[half:]), is_first=True)
        elif is_first:
            yield from self._run(function, missing, is_first=False)
        else:
            yield left[0][0], WorkerKilledError()

    def _run_once(
        self, function: Callable[..., Any], calls: Mapping[int, Call]
    ) -> Iterator[tuple[int, Any]]:
        parallel = Parallel(
            n_jobs=self._jobs,
            backend='loky',
            return_as='generator_unordered',
            batch_size=1,
            pre_dispatch='all',
        )
        with interrupts_blocked():  # keep Ctrl-C from the workers that start here
            results = parallel(
                delayed(_run_numbered)(index, function, call) for index, call in calls.items()
            )
        yield from results


class _Cluster(Workers):
    """The workers of a Dask cluster, also those that join it later.

    The futures of Dask are used directly. With joblib 1.6, calls by its backend "dask" never end if
    a call has killed too many workers.
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def as_they_end(
        self, function: Callable[..., Any], calls: Sequence[Call]
    ) -> Iterator[tuple[int, Any]]:
        """Yield the index and the result of each call as soon as it has ended."""
        from distributed import CancelledError, KilledWorker, as_completed

        futures = [
            self._client.submit(_run_on_one_thread, function, call, pure=False) for call in calls
        ]
        indices = {future: index for index, future in enumerate(futures)}
        for future in as_completed(futures):
            try:
                yield indices[future], future.result()
            except KilledWorker:
                yield indices[future], WorkerKilledError()
            except CancelledError as error:
                raise MusculoskeletalError(
                    'the scheduler of the cluster has ended, or cannot be reached any more; start '
                    'it again, and then this program'
                ) from error
            except RuntimeError as error:
                if isinstance(error.__cause__, ImportError):
                    raise MusculoskeletalError(
                        f'a worker of the cluster lacks a package: {error.__cause__}; start the '
                        'workers with the Python environment of this process'
                    ) from error
                raise


def _run_numbered(index: int, function: Callable[..., Any], call: Call) -> tuple[int, Any]:
    return index, _run_on_one_thread(function, call)


#: held while this process runs a call; calls share the threads and the random numbers of torch
_CALLING = threading.RLock()


def _run_on_one_thread(function: Callable[..., Any], call: Call) -> Any:
    if not _CALLING.acquire(blocking=False):
        raise MusculoskeletalError(
            f'a worker on {socket.gethostname()} runs several calls at the same time; start the '
            'workers with one thread each: dask worker ADDRESS --nthreads 1 --nworkers=-1'
        )
    try:
        torch.set_num_threads(1)
        with threadpool_limits(1):
            return function(*call)
    finally:
        _CALLING.release()
