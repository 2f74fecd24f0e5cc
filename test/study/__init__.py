# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Studies of the package, which is installed without them: the paper's results, and others.

`results` keeps finished cells, `sites` makes gardens and models, `trials` judges maps. `tables`
makes the paper's results of `paper` and `comparisons`; `light`, `rig`, `year` and `large` are
studies of their own, `bags` one of given bags; `half_real` makes bags of a real robot's logs.
`page` puts results onto the pages, with the figures of `overview`.
"""
