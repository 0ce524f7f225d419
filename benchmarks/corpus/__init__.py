"""The corpus: drives of many kinds with truth, each run and judged; `python -m benchmarks corpus`.

A row a drive: error over all scans, error over claimed sigma, NEES of the last pose and of the landmarks, duplicates,
and what the run says of itself. `drives` and `handheld` make them, `catalogue` names them, `score` judges a run,
`process` runs each with a time limit, `summary` puts rows together by kind.
"""
