# SPDX-License-Identifier: Apache-2.0
"""What people read: report.html and the README's table, both made from result.json."""
