# SPDX-License-Identifier: Apache-2.0
"""The two presets, and the interface that they share."""
