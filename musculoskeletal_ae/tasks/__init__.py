# SPDX-License-Identifier: Apache-2.0
"""What is done with the network: estimate, detect anomalies, control, explore."""
