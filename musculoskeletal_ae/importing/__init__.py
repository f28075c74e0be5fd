# SPDX-License-Identifier: Apache-2.0
"""Robot descriptions out of other people's formats: what `import_robot` does."""
