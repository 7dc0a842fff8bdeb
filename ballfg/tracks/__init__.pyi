from .dataset import Dataset as Dataset
from .dataset import read_dataset as read_dataset
from .info import TABLE_TENNIS as TABLE_TENNIS
from .info import Ball as Ball
from .table import TableWriter as TableWriter
from .track import Label as Label
from .track import Track as Track
from .writing import write_dataset as write_dataset
