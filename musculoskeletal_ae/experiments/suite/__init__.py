# SPDX-License-Identifier: Apache-2.0
"""The paper's experiments one by one on one individual: numbers and traces, no plots."""
