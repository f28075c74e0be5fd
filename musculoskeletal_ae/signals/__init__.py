# SPDX-License-Identifier: Apache-2.0
"""Converts raw messages of the muscle modules to checked samples for all other parts."""
