# SPDX-License-Identifier: Apache-2.0
"""A learned body as a model of another format."""
