# SPDX-License-Identifier: Apache-2.0
"""Estimates joint angles from every message, and monitors whether the body is healthy.

`estimator` connects the parts; begin there.
"""
