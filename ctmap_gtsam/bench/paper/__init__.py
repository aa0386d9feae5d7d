"""The paper's benchmark on simulated places: Table I, pose accuracy, what hindsight adds, what each assumption buys.

All of it is synthetic. `protocol` says what is done, `places` and `units` do it, `agenda` says in which order,
`results` makes figures of it, `tables` and `plots` show them.
"""

from ctmap_gtsam.bench.paper.protocol import SETTINGS, Protocol, Variant, load_protocol
from ctmap_gtsam.bench.paper.running import Outcome, Task, Workshop, freeze, run_paper

__all__ = ["SETTINGS", "Outcome", "Protocol", "Task", "Variant", "Workshop", "freeze", "load_protocol", "run_paper"]
