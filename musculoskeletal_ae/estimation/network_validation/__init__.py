# SPDX-License-Identifier: Apache-2.0
"""The four checks of checkpoint validation, one per file; `validator` runs them."""
