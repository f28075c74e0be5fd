# SPDX-License-Identifier: Apache-2.0
"""Online learning: collects samples, and updates body and network.

`learner` connects the parts; begin there. In the order of a sample: `collector` takes samples at
rest (`rest`), `samples` keeps them, `scheduler` begins an update, `trainer` runs it in a process of
its own, `body_updater` makes it, and `checkpoint_keeper` publishes the network. `state_directory`
saves samples and network. `body_model/` has the body that an update fits.
"""
