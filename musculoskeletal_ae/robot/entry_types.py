# SPDX-License-Identifier: Apache-2.0
"""Types of values that the files of a robot directory have in common, with their legal ranges."""

from typing import Annotated

from msgspec import Meta

#: refuse a number beyond ± this [SI units], because it is certainly a mistake
LARGEST = 1e8
LONGEST_LIST = 1000  # refuse a longer list, such as of muscles, route points or joints

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Meta(gt=0.0, le=LARGEST)]
NotNegative = Annotated[float, Meta(ge=0.0, le=LARGEST)]
Vector = tuple[Number, Number, Number]
Name = Annotated[str, Meta(min_length=1, max_length=200)]
Names = Annotated[tuple[Name, ...], Meta(min_length=1, max_length=LONGEST_LIST)]
