from .choices import Choices as Choices
from .choices import Guess as Guess
from .choices import UndecidedError as UndecidedError
from .choices import parse_columns as parse_columns
from .importer import import_tracks as import_tracks
from .proposal import Proposal as Proposal
from .proposal import propose as propose
from .writing import write_import as write_import
