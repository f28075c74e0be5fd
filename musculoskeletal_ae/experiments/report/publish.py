# SPDX-License-Identifier: Apache-2.0
"""Writing what was measured: result.json, plots and the report."""

from __future__ import annotations

from pathlib import Path

from musculoskeletal_ae.experiments.figures.gallery import PLOTTERS
from musculoskeletal_ae.experiments.report.page import write_page
from musculoskeletal_ae.experiments.suite.results import combined, write
from musculoskeletal_ae.experiments.suite.run import Everything
from musculoskeletal_ae.experiments.suite.study import Study


def publish(study: Study, found: Everything, out: Path) -> list[Path]:
    """Write everything; return the files. The page keeps what earlier calls left in the folder."""
    robot = study.body()
    files = []
    for name, rows in found.items():
        result = combined(study, {seed: row.numbers for seed, row in rows.items()})
        plots = PLOTTERS[name](study, robot, rows, out / name)
        result['plots'] = [{'file': plot.file.name, 'caption': plot.caption} for plot in plots]
        file = out / name / 'result.json'
        write(result, file)
        files += [file, *(plot.file for plot in plots)]
    return [*files, write_page(out)]
