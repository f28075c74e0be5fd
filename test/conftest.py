# SPDX-License-Identifier: Apache-2.0
"""What all tests share."""

from __future__ import annotations

from hypothesis import settings

# Compiled code is loaded in somebody's first example; no test here judges time.
settings.register_profile('no deadline', deadline=None)
settings.load_profile('no deadline')
