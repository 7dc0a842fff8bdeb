from .dataset import Dataset as Dataset, read_dataset as read_dataset
from .info import TABLE_TENNIS as TABLE_TENNIS, Ball as Ball
from .table import TableWriter as TableWriter
from .track import Label as Label, Track as Track
from .writing import write_dataset as write_dataset
