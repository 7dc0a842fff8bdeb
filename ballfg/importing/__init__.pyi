from .choices import Choices as Choices
from .formats.sources import Format as Format, register_format as register_format
from .importer import import_tracks as import_tracks
