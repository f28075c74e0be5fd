# SPDX-License-Identifier: Apache-2.0
"""No message and no request ends a node: what a callback lets out is counted, and it goes on."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor


class ShieldedExecutor(SingleThreadedExecutor):
    """Tells the node what its callbacks let out, rclpy's own for /clock and parameters included."""

    def _make_handler(self, entity: Any, node: Any, take_from_wait_list: Any) -> Any:
        def escaped(error: Exception) -> None:
            # The end, asked for by a callback or by a signal while it published, is none.
            if isinstance(error, ExternalShutdownException) or not self.context.ok():
                raise error
            named = getattr(entity, 'topic_name', None) or getattr(entity, 'srv_name', None)
            node.survive(named or type(entity).__name__, error)

        def take(entity: Any) -> Any:
            try:
                work = take_from_wait_list(entity)
            except Exception as error:  # noqa: BLE001 - else the executor never asks it again
                return escaped(error)
            if work is None:
                return None

            async def shielded() -> None:
                try:
                    await work()
                except Exception as error:  # noqa: BLE001
                    escaped(error)

            return shielded

        return super()._make_handler(entity, node, take)


def refuse(request: Any, response: Any, reason: str) -> None:
    """Let the response to a request that could not be worked on say so, where it can."""
    refused = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, 'results'):  # of parameters, those done before
        response.results += [refused] * (len(request.parameters) - len(response.results))
    elif isinstance(getattr(response, 'result', None), SetParametersResult):
        response.result = refused
    elif hasattr(response, 'success'):
        response.success, response.message = False, reason
