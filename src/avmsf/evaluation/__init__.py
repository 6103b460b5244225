"""Evaluation: how far predicted sounds are from recorded ones, of any method on any dataset.

In go recordings with their contacts; out come one value for each metric, method and held-out recording, and a report.

- `Renderer` (`task`): anything that turns contacts into sounds. A *method* fits one to a `Task`: the training
  recordings of one object, and what may be made of them (modes, features, elastic bodies, Gaussians).
- `registry`: the tables of all methods, protocols and metrics, and settings. A new one is a function and a line.
- `splits`: farthest-point, leave-one-out and other splits of contacts, `Case`s as data. `scores`: a renderer's values.
- Metrics: spectral, log-mel and envelope distance (`metrics`); CDPAM (`cdpam`; Manocha et al., ICASSP 2021); CLAP score
  (`clap`); modal assurance criterion and errors of modes and gains against a simulation's (`modal_metrics`); error of
  located contacts (`localization`); edits to another material (`editing`, `mode_embedding`).
- `methods`: all methods by name, those of the sound field as configurations of the pipeline. Their renderers: k nearest
  recordings, mean gains, thin-plate splines (`simple_methods`), DiffSound and SonicGauss (`avmsf.baselines`), files.
- `plan_evaluation` (`plan`) makes an `Evaluation`; `objects` makes what its methods read of objects. `run_objects`
  (`runner`) runs it in this process or in others, into a `ResultsFolder` (`results`) that a stopped run goes on with;
  `tables` makes means, ratios to `knn3` and tables, with the paper's values (`published`), and `report` one report, as
  Markdown and as a page.

Start at `evaluate` in `scores`, then `runner.CaseRun.outcome`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
