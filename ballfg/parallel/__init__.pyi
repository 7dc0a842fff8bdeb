from .executor import on_cluster as on_cluster
