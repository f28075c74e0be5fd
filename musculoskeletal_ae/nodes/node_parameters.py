# SPDX-License-Identifier: Apache-2.0
"""The parameters of one node: declared from `PARAMETERS`, checked, and passed to setters."""

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.declared_parameters import PARAMETERS
from musculoskeletal_ae.parameters import Parameter, naming_parameter


class NodeParameters:
    """Declares the parameters of a node, and passes their checked values to setters.

    Parameters of one request are set together or not at all.
    """

    def __init__(self, node: Node, name: str) -> None:
        """Declare the parameters of the node `name` in `PARAMETERS`.

        Raises:
            MusculoskeletalError: If a value at the start is not legal.
        """
        self._node, self._table = node, PARAMETERS[name]
        self._setters: dict[str, Callable[[Any], object]] = {}
        self._prepare: dict[str, Callable[[Any], object]] = {}
        self._proposed: dict[str, Any] = {}  # values of a request that is being checked
        for key, parameter in self._table.items():
            default = parameter.default
            default = list(default) if isinstance(default, tuple) else default
            node.declare_parameter(key, default, _descriptor(parameter))
            self.value(key)  # raises if the value is not legal
        node.add_on_set_parameters_callback(self._set)

    def value(self, name: str) -> Any:
        """Return the checked value of a parameter; a list becomes a tuple without empty names.

        Raises:
            MusculoskeletalError: If the value is not legal.
        """
        with naming_parameter(name):
            value = self._proposed.get(name, self._held(name))
            return self._table[name].checked(value)

    def follow(
        self,
        name: str,
        setter: Callable[[Any], object],
        prepare: Callable[[Any], object] | None = None,
    ) -> None:
        """Call `setter` with the value of a parameter now, and whenever the parameter is set.

        A request may set several parameters. If one of them is refused, the setters that were
        already called for this request are called again with the previous values.

        A setter whose effect cannot be undone in this way needs a function `prepare`, which checks
        the value beforehand. Such setters are called last, in the order of registration. Only the
        first one of them may still raise an error. If several parameters of a request share such a
        setter, it is called once, with the value of the last of these parameters.

        Args:
            name: Name of the parameter.
            setter: Uses the value it is called with, or raises a MusculoskeletalError to refuse it.
            prepare: Converts the value for `setter`, or raises a MusculoskeletalError to refuse it.
                If it returns None, `setter` is not called.
        """
        self.on_change(name, setter, prepare)
        self._take({name: self._held(name)})

    def on_change(
        self,
        name: str,
        setter: Callable[[Any], object],
        prepare: Callable[[Any], object] | None = None,
    ) -> None:
        """Call `setter` whenever the parameter is set; unlike `follow`, do not call it now.

        `prepare`, if given, converts and checks the value before `setter` is called (see `follow`).
        """
        self._setters[name] = setter
        if prepare is not None:
            self._prepare[name] = prepare

    def _held(self, name: str) -> Any:
        value = self._node.get_parameter_or(name, RosParameter(name)).value
        # rcl reads an empty list on the command line as None.
        return [] if value is None and isinstance(self._table[name].default, tuple) else value

    def _take(self, values: dict[str, Any]) -> None:
        """Set parameters together; if one is refused, restore the others and raise."""
        legal, last = dict[str, Any](), dict[Callable[[Any], object], tuple[str, Any]]()
        for name in filter(values.__contains__, self._setters):
            with naming_parameter(name):
                legal[name] = self._table[name].checked(values[name])
                if prepare := self._prepare.get(name):
                    prepared = prepare(legal.pop(name))
                    if prepared is not None:
                        last[self._setters[name]] = name, prepared
        taken: list[str] = []
        try:
            for name, value in legal.items():
                with naming_parameter(name):
                    self._setters[name](value)
                taken.append(name)
            for setter, (name, value) in last.items():
                with naming_parameter(name):
                    setter(value)
        except MusculoskeletalError:
            self._proposed = {}
            for name in reversed(taken):
                self._setters[name](self.value(name))
            raise

    def _set(self, parameters: list[RosParameter]) -> SetParametersResult:
        self._proposed = {p.name: p.value for p in parameters}
        try:
            self._take(self._proposed)
        except MusculoskeletalError as error:
            return SetParametersResult(successful=False, reason=str(error))
        finally:
            self._proposed = {}
        return SetParametersResult(successful=True)


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=parameter.description,
        read_only=not parameter.settable,
        dynamic_typing=parameter.is_number_list,  # rclpy reads `[]` as an array of bytes
    )
    if parameter.within is not None:
        low, high = parameter.within
        if isinstance(parameter.default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return descriptor
