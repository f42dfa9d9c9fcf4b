"""What the first screen answers: how fast is ours, against what I use, on my kind of problem?"""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

from benchmarks._names import name_of
from benchmarks._reached import Took, took
from benchmarks.studies.report._compare import Tally, ratio, tally, verdict
from benchmarks.studies.report._scene import Scene


class Peer(NamedTuple):
    """What somebody uses now: its name here, and the methods that stand for it, best first."""

    key: str
    name: str
    methods: tuple[str, ...]
    residuals_only: bool = False


class Size(NamedTuple):
    key: str
    name: str
    least: int
    most: float


PEERS = (
    Peer("cma-es", "CMA-ES", ("cma_es", "cma_es_diagonal")),
    Peer("bobyqa", "BOBYQA", ("py_bobyqa",)),
    Peer("dfo-ls", "DFO-LS", ("dfo_ls",), residuals_only=True),
    Peer("nelder-mead", "Nelder-Mead", ("nelder_mead",)),
    Peer("differences", "finite differences, Adam", ("finite_differences", "grey_differences")),
    Peer("fr22", "FR22", ("fr22", "grey_fr22")),
    Peer("mitsuba", "Mitsuba’s AD", ("mitsuba_ad",)),
    Peer("zerograds", "ZeroGrads", ("zerograds",)),
)
SIZES = (
    Size("few", "1 to 4", 1, 4),
    Size("some", "5 to 30", 5, 30),
    Size("many", "100 and more", 31, float("inf")),
)
PLATEAUS = {"plateaus": "plateaus", "smooth": "no plateaus"}
SEEN = {"number": "one number", "residuals": "residuals"}


class Pair(NamedTuple):
    """Ours and the other on one scene, by their methods."""

    scene: Scene
    ours: str
    theirs: str

    def took(self, cost: str) -> tuple[Took, Took]:
        """Ours first."""
        ours, theirs = (took(self.scene.ran[name], cost) for name in (self.ours, self.theirs))
        return ours, theirs


class Answer(NamedTuple):
    """One answer: who was compared on which scenes, and what came out in each cost."""

    peer: Peer
    size: Size
    plateaus: str  # a key of PLATEAUS
    seen: str  # a key of SEEN
    pairs: list[Pair]

    @property
    def key(self) -> str:
        """For links."""
        return "-".join((self.peer.key, self.size.key, self.plateaus, self.seen))

    @property
    def ours(self) -> str:
        """The names of what was compared with it."""
        return " or ".join(dict.fromkeys(name_of(pair.ours) for pair in self.pairs))

    def tally(self, cost: str) -> Tally:
        """What came out over the scenes."""
        return tally([pair.took(cost) for pair in self.comparable(cost)])

    def comparable(self, cost: str) -> list[Pair]:
        """The scenes on which the cost of both can be compared."""
        return [p for p in self.pairs if p.theirs in p.scene.comparable(cost, p.ours)]

    def close(self, cost: str) -> bool:
        """Whether the quartiles overlap on the only scene that both solve."""
        pairs = [pair.took(cost) for pair in self.comparable(cost)]
        return [verdict(*pair) for pair in pairs if ratio(*pair) is not None] == ["tie"]

    @property
    def solved(self) -> tuple[int, int]:
        """On how many of the scenes ours gets to 99 %, and the other."""
        ours, theirs = zip(*(pair.took("evaluations") for pair in self.pairs), strict=True)
        return sum(of.reached for of in ours), sum(of.reached for of in theirs)

    @property
    def starts(self) -> tuple[int, int, int, int]:
        """From how many starts ours gets there, of how many, and the same for the other."""
        ours, theirs = zip(*(pair.took("evaluations") for pair in self.pairs), strict=True)
        both = (
            (sum(of.solved for of in each), sum(of.starts for of in each))
            for each in (ours, theirs)
        )
        (a, b), (c, d) = both
        return a, b, c, d

    @property
    def why_none(self) -> str:
        """Why there is no answer."""
        if self.peer.residuals_only and self.seen == "number":
            return f"{self.peer.name} needs residuals"
        return "not measured on such a scene"


def answers(scenes: Sequence[Scene]) -> Iterator[Answer]:
    """All of them, in the order in which the page asks."""
    for peer, size, plateaus, seen in product(PEERS, SIZES, PLATEAUS, SEEN):
        pairs = [
            pair
            for scene in scenes
            if size.least <= scene.results["dimensions"] <= size.most
            and scene.plateaus == (plateaus == "plateaus")
            and (pair := _pair(scene, peer, seen)) is not None
        ]
        yield Answer(peer, size, plateaus, seen, pairs)


def _pair(scene: Scene, peer: Peer, seen: str) -> Pair | None:
    """Ours and the best of those that stand for the peer; None where one of them did not run."""
    ours = scene.with_residuals if seen == "residuals" else scene.with_one_number
    ran = [name for name in peer.methods if name in scene.ran]
    if ours is None or not ran or (peer.residuals_only and seen == "number"):
        return None
    return Pair(scene, ours, min(ran, key=lambda name: took(scene.ran[name], "evaluations").median))
