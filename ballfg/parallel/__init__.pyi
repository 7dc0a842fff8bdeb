from .executor import CLUSTERS as CLUSTERS
from .executor import Executor as Executor
from .executor import on_cluster as on_cluster
