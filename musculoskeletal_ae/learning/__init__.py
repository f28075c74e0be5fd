# SPDX-License-Identifier: Apache-2.0
"""Online learning: collects samples, and updates body and network.

`learner` connects the parts; begin there. A sample passes through them in this order: `collector`
takes it when the arm rests (`rest`), `samples` keeps it, `scheduler` begins an update, `trainer`
runs the update in a process of its own, `body_updater` makes it, and `checkpoint_keeper` publishes
the network. `state_directory` saves samples and network. `body_model/` has the body that an update
fits.
"""
