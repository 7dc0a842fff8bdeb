"""Registries give classes by name: those of this package, of the user and of other installed packages.

Another package registers a class by an entry point in its pyproject.toml:

    [project.entry-points."ballfg.effects"]
    static_charge = "my_package.charge:StaticCharge"
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, packages_distributions, version
from pkgutil import resolve_name
from types import ModuleType
from typing import Any, Generic, TypeVar, cast

from ballfg.interrupts import is_interrupt

T = TypeVar("T")
C = TypeVar("C", bound=type[Any])
PACKAGE = "ballfg"


@dataclass(frozen=True)
class Source:
    """The package that a registered class comes from."""

    package: str  # Name of the installed package; the name of the module without one

    version: str | None  # None without an installed package

    def __str__(self) -> str:
        return self.package if self.version is None else f"{self.package} {self.version}"


@dataclass(eq=False, repr=False)
class Registry(Mapping[str, type[T]], Generic[T]):
    """Classes of one kind by their `name`.

    Classes of this package come first, in the order of their registration; the others follow by name. Entry points of
    installed packages are loaded at the first iteration or missed lookup, never at import.

    Args:
        sort: the word for one of the classes in messages, such as "estimator".
        group: of the entry points, for instance "ballfg.estimators".
        base: the class or classes of which each must be a subclass.
        remedy: last sentence of messages about classes that cannot be registered.
        check: raises an exception for a faulty class from outside of the package.
        reserved: classes by name outside of the registry; their names are taken.
        own: places of classes of this package by name, `module:Class`, which are imported on demand.
    """

    sort: str
    _: KW_ONLY
    group: str
    base: type[Any] | tuple[type[Any], ...]
    remedy: str
    check: Callable[[type[T]], None] | None = None
    reserved: Mapping[str, type[T]] = field(default_factory=dict)
    own: Mapping[str, str] = field(default_factory=dict)

    _classes: dict[str, type[T]] = field(init=False, default_factory=dict)
    _packages: dict[str, Source] = field(init=False, default_factory=dict)
    _loaded: bool = field(init=False, default=False)

    def __getitem__(self, name: str) -> type[T]:
        if not isinstance(name, str):
            raise KeyError(name)
        if name not in self._classes and name in self.own:
            self._classes[name] = resolve_name(self.own[name])
        if name not in self._classes:
            self.load_entry_points()
        return self._classes[name]

    def __iter__(self) -> Iterator[str]:
        self.load_entry_points()
        own = dict.fromkeys([*self.own, *(name for name, cls in self._classes.items() if _is_own(cls))])
        return iter([*own, *sorted(set(self._classes) - set(own))])

    def __len__(self) -> int:
        self.load_entry_points()
        return len({*self.own, *self._classes})

    def __repr__(self) -> str:
        return f"Registry of {self.sort}s: {', '.join(self)}"

    def register(self, cls: C) -> C:
        """Registers a class under its name; may decorate the class.

        A class that is defined again, as in a repeated notebook cell, replaces the previous one.

        Args: cls: a subclass of the registry's base, with a class attribute `name`.
        Returns: the same class.
        Raises:
            TypeError: if it is not such a class.
            ValueError: if its name is missing or taken, or if the registry's own check refuses it.
        """
        if not (isinstance(cls, type) and issubclass(cls, self.base)):
            names = [base.__name__ for base in (self.base if isinstance(self.base, tuple) else (self.base,))]
            bases = " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))
            got = " ".join(repr(cls)[:80].split())  # on one line, also for an array
            raise TypeError(f"{self.sort} must be a subclass of {bases}; got {got}. {self.remedy}")
        name = getattr(cls, "name", None)
        if not (isinstance(name, str) and name.strip()):
            raise ValueError(f"{cls.__qualname__}.name must be a text; it is missing. {self.remedy}")
        if self.check is not None and not _is_own(cls):
            self.check(cls)
        taken = self[name] if name in self.own else self._classes.get(name) or self.reserved.get(name)
        if taken is not None and _place(taken) != _place(cls):
            article = "an" if self.sort[0] in "aeiou" else "a"
            raise ValueError(
                f"name of {article} {self.sort} must be its own; got '{name}', that of {_place(taken)}, "
                f"for {_place(cls)}. Rename one."
            )
        self._classes[name] = cls
        return cls

    def lookup(self, name: str) -> type[T]:
        """The class of a name. Raises: ValueError: if there is none; the message lists the names there are."""
        if name in self:
            return self[name]
        raise ValueError(
            f"there is no {self.sort} '{name}'; known ones: {', '.join(self) or 'none'}. One of your own must be "
            f"registered first, or its package installed with an entry point '{self.group}'."
        )

    def source(self, name: str) -> Source:
        """The package of a registered class, with its version."""
        cls = self[name]
        return self._packages[name] if name in self._packages else source_of(cls)

    def load_entry_points(self) -> None:
        """Registers the classes from entry points of other installed packages, the first time only.

        Raises: ValueError: if an entry point cannot be used; the message names it and its package.
        """
        if self._loaded:
            return
        self._loaded = True
        try:
            for point in sorted(entry_points(group=self.group), key=lambda point: (str(_package(point)), point.name)):
                self._load(point)
        except BaseException:
            self._loaded = False
            raise

    def _load(self, point: EntryPoint) -> None:
        """Registers the class of an entry point; a module registers its classes, a function is called."""
        before = dict(self._classes)
        try:
            offered = point.load()
            if isinstance(offered, type):
                self.register(offered)
                before.pop(cast("Any", offered).name, None)  # its module may have registered it already
            elif not isinstance(offered, ModuleType):
                offered()
        except BaseException as error:  # sys.exit in it would end the command
            if is_interrupt(error):
                raise
            raise ValueError(
                f"entry point '{point.name}' = '{point.value}' of package {_package(point)} (group {self.group}) "
                f"cannot be used ({type(error).__name__}: {error}). Mend or uninstall that package."
            ) from error
        new = {name for name, cls in self._classes.items() if before.get(name) is not cls}
        self._packages |= dict.fromkeys(new, _package(point))

    @contextmanager
    def restored(self) -> Iterator[None]:
        """A block whose registrations are undone at its end, for tests."""
        before = dict(self._classes)
        try:
            yield
        finally:
            self._classes = before


def source_of(cls: type[Any]) -> Source:
    """The package in which a class is defined, with its version."""
    top = cls.__module__.partition(".")[0]
    package = PACKAGE if top == PACKAGE else next(iter(packages_distributions().get(top, ())), top)
    try:
        return Source(package, version(package))
    except PackageNotFoundError:
        return Source(cls.__module__, None)


def _place(cls: type[Any]) -> str:
    """Module and name of a class: two classes with equal ones are the same class, defined again."""
    return f"{cls.__module__}.{cls.__qualname__}"


def _is_own(cls: type[Any]) -> bool:
    return cls.__module__.partition(".")[0] == PACKAGE


def _package(point: EntryPoint) -> Source:
    return Source("of unknown name", None) if point.dist is None else Source(point.dist.name, point.dist.version)
