# SPDX-License-Identifier: Apache-2.0
"""Messages: when they arrive, which are used, and their contents as arrays."""
