"""The paper's claims, a notebook's findings for them, and the verdict on each.

A notebook collects its findings and writes them at its end:

    findings = Findings("04_pixels", folder, profile)
    findings.add("px.latent.route", mean, fixed=fixed, low=low, high=high, test="over floor", p=p, holds=True)
    findings.write()
"""

import math
import operator
import re
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal
from zlib import crc32

import numpy as np
from pydantic import Field, model_validator

from lt_lib.report.entries import parsed, read_entries
from lt_lib.report.firmness import FEW, RESAMPLES, firmness
from lt_lib.report.inferred import INFERRED, calibrating_rows
from lt_lib.settings.base import ROOT, Settings, UserError, require_known
from lt_lib.store.files import write_checked

Notebook = Literal[
    "01_occlusion_check", "02_encoder", "03_gridworld", "04_pixels", "05_coverage_sweep",
    "06_z_study", "07_corruption", "08_hardware_decode", "09_scoreboard",
    "10_speed",
]  # fmt: skip
Number = int | float
Numbers = Number | tuple[Number, ...]
Value = Number | str | tuple[Number, ...]

CLAIMS = ROOT / "params" / "claims.yaml"
JUDGED = "full"  # smaller profiles have too few seeds for any test, and nobody shall take them for results
REPRODUCED, SAME_DIRECTION, NOT_REPRODUCED = "reproduced", "same direction", "not reproduced"
CALIBRATED, CONTEXT, GATE, NEEDS_A_ROBOT = "calibrated", "context", "gate", "needs a robot"
NOT_RUN, NO_VERDICT = "not run", ""
CRITERIA = ("digits", "margin", "at_least", "at_most", "equal", "between")
ALLOWED = {
    "exact": ("digits", "between"),
    "config": (),
    "scene": CRITERIA[2:],
    "measured": CRITERIA[1:],
    "hardware": CRITERIA[1:],
    "ours": (),
}
TESTED = ("measured", "hardware")  # kinds whose rows need a test that could fail


class Claim(Settings):
    """One entry of claims.yaml; the head of that file explains every field."""

    id: str
    nb: Notebook
    kind: Literal["exact", "config", "measured", "scene", "hardware", "ours"]
    what: str
    paper: Value
    sd: float | None = None
    n: int | None = None
    range: tuple[float, float] | None = None
    check: str = ""
    unit: str = ""
    refuted: str = ""
    follows: str = ""
    gate: bool = False
    calibrates: str = ""  # the setting that was inferred from this row; stands in inferred.yaml, not here
    digits: int | None = None
    margin: Numbers | None = None
    at_least: Number | None = None
    at_most: Number | None = None
    equal: Number | None = None
    between: tuple[Number, Number] | None = None

    @model_validator(mode="after")
    def _criterion_suits_the_kind(self) -> "Claim":
        criteria = [name for name in CRITERIA if getattr(self, name) is not None]
        allowed = ALLOWED[self.kind]
        if len(criteria) > 1 or not set(criteria) <= set(allowed):
            raise UserError(f"{self.id}: kind {self.kind} allows at most one of {allowed}, got {criteria}")
        if self.kind in TESTED and not self.follows and not self.gate and not self.refuted:
            raise UserError(f"{self.id}: a measured claim says what would refute it; give `refuted`")
        if not criteria and self.kind not in ("config", "ours") and not self.check and numbers(self.paper):
            raise UserError(f"{self.id}: no criterion for reproduction; give one of {allowed} or a check")
        if isinstance(self.margin, tuple) and len(self.margin) != len(numbers(self.paper) or ()):
            raise UserError(f"{self.id}: expected one margin for each of {self.paper}, got {self.margin}")
        return self

    @property
    def criterion(self) -> str:
        """Name of the one machine-readable criterion, or '' if there is none."""
        return next((name for name in CRITERIA if getattr(self, name) is not None), "")

    @property
    def tested(self) -> bool:
        """Whether the row needs a test of its own, one that could fail."""
        return self.kind in TESTED and not self.gate


class Finding(Settings):
    """What a notebook found for one claim.

    value        of the same kind as the claim's: a number, words, "k of n", or a list (a pair, a range, one per case)
    seeds        one value per seed, where there are seeds
    low, high    95% interval of the value; a list if the value is a list
    n            number of seeds, or of the runs or episodes over which the value is a mean or a count
    test, p      the claim's own test in words, and its p
    holds        whether that test holds; None if the claim has no test
    judge        name of the function that judged it, which the tests feed with a result that refutes the claim
    firm         share of resamples of its seeds and episodes that give the same verdict; None if it has no sample
    note         a few words on a deviation: what was tried, what the cause is
    real_frames  (hardware) whether the frames came from the physical camera
    """

    value: Value
    seeds: tuple[Number, ...] | None = None
    low: Numbers | None = None
    high: Numbers | None = None
    n: Annotated[int, Field(gt=0)] | None = None
    test: str = ""
    p: Annotated[Number, Field(ge=0, le=1)] | None = None
    holds: bool | None = None
    judge: str = ""
    firm: Annotated[Number, Field(ge=0, le=1)] | None = None
    note: str = ""
    real_frames: bool = False


def load_claims(path: Path = CLAIMS) -> dict[str, Claim]:
    """Every claim by its id, in the order of the file.

    Raises a one-line UserError with the id for an unreadable file, an unknown key or notebook, a missing or malformed
    value, a duplicate id, and a criterion that does not suit the kind.
    """
    claims, rows = read_entries(path, Claim, "id"), calibrating_rows()
    for claim in claims.values():
        if claim.calibrates:
            raise UserError(f"{path.name}: {claim.id}: calibrates: stands in {INFERRED.name} alone; leave it out here")
    return {name: claim.model_copy(update={"calibrates": rows.get(name, "")}) for name, claim in claims.items()}


def numbers(value: Value) -> tuple[Number, ...] | None:
    """The numbers in a value; "k of n" is the proportion k / n, and words have none."""
    if isinstance(value, str):
        count = re.fullmatch(r"(\d+) of ([1-9]\d*)", value)
        return (int(count[1]) / int(count[2]),) if count else None
    return value if isinstance(value, tuple) else (value,)


def verdict(claim: Claim, finding: Finding | None, profile: str) -> str:
    """The verdict on one claim.

    not run         there is no finding
    '' (none)       the profile is not the full one, so the run is too small to tell
    needs a robot   a hardware claim without real frames; with real frames it counts as measured
    calibrated      a setting that the paper does not print was inferred from this row, so it counts for nothing; but
                    words that no value of the setting makes true are not reproduced
    gate            a threshold that stops the run where it is missed, so the row cannot fail
    context         geometry or settings that the paper does not print, or a finding that it does not have
    reproduced      the claim's criterion (below) is met, and its own test, which could have failed, holds
    same direction  a measured claim misses its criterion, but its own test holds
    not reproduced  everything else

    The criterion applies to each component of a list; beside one number of the paper, each of ours must meet it.
    exact           prints like the paper's value at its number of digits
    config          equals the paper's value; numbers to a part in 1e9
    others          lies within the margin or meets the machine-readable check; equals the paper's words; without
                    either, the notebook's test decides alone
    """
    if finding is None:
        return NOT_RUN
    if profile != JUDGED:
        return NO_VERDICT
    if claim.calibrates and (numbers(claim.paper) or finding.value == claim.paper):
        return CALIBRATED
    if claim.kind == "hardware" and not finding.real_frames:
        return NEEDS_A_ROBOT
    met = _criterion_met(claim, finding)
    if claim.kind in ("scene", "ours") and met:
        return CONTEXT
    if claim.gate and met:
        return GATE
    if finding.holds is False or (claim.tested and finding.holds is None):
        return NOT_REPRODUCED
    if met:
        return REPRODUCED
    return SAME_DIRECTION if claim.tested else NOT_REPRODUCED


def _criterion_met(claim: Claim, finding: Finding) -> bool:
    """Whether the finding meets the criterion of its claim; see `verdict`."""
    ours, paper = numbers(finding.value), numbers(claim.paper)
    if claim.kind == "ours":
        return True
    if paper is None:
        return finding.value == claim.paper
    papers = paper * len(ours) if len(paper) == 1 else paper
    match claim.criterion:
        case "digits":
            return [f"{a:.{claim.digits}f}" for a in ours] == [f"{b:.{claim.digits}f}" for b in papers]
        case "margin":
            margins = claim.margin if isinstance(claim.margin, tuple) else (claim.margin,) * len(ours)
            # the last term admits a distance that equals the margin in decimals
            return all(abs(a - b) <= m + 1e-9 for a, b, m in zip(ours, papers, margins, strict=True))
        case "at_least":
            return min(ours) >= claim.at_least
        case "at_most":
            return max(ours) <= claim.at_most
        case "equal":
            return all(a == claim.equal for a in ours)
        case "between":
            return claim.between[0] <= min(ours) and max(ours) <= claim.between[1]
    if claim.kind == "config":
        return all(map(math.isclose, ours, papers))
    return True  # the check is in words alone


class Findings:
    """Collects the findings of one notebook and writes them to <outputs>/results/<notebook>.json.

    notebook  its name, e.g. '04_pixels'
    outputs   the profile's output folder
    profile   the profile that produced the numbers; it is recorded with them

    Raises UserError for an unknown notebook.
    """

    def __init__(self, notebook: str, outputs: Path, profile: str, claims: Mapping[str, Claim] | None = None):
        require_known([notebook], Notebook.__args__, "notebook")
        everything = load_claims() if claims is None else claims
        self.notebook, self.profile = notebook, profile
        self.path = Path(outputs) / "results" / f"{notebook}.json"
        self.claims = {name: claim for name, claim in everything.items() if claim.nb == notebook}
        self.found: dict[str, Finding] = {}

    def add(self, name: str, value: Any, *, seeds: Any = None, n: Any = None, **fields: Any) -> None:
        """Adds the finding for the claim of this id; the other fields are those of `Finding`.

        Numbers may be numpy scalars and lists numpy arrays. By default, n is the number of seeds.

        Raises a one-line UserError with the id for an id that belongs to another notebook or was already added, an
        unknown field, a value that is not finite or not shaped like the paper's, an inverted interval, and a missing
        `holds` of a measured claim.
        """
        where = f"{self.notebook}: {name}"
        if name not in self.claims:
            raise UserError(f"{where} is not one of its claims; they are {', '.join(self.claims)}")
        if name in self.found:
            raise UserError(f"{where} was already added")
        count = len(seeds) if n is None and seeds is not None else n
        entry = {key: _plain(item) for key, item in dict(value=value, seeds=seeds, n=count, **fields).items()}
        for key, item in entry.items():
            if not all(math.isfinite(x) for x in np.ravel(item) if isinstance(x, float)):
                raise UserError(f"{where}: {key} must be finite, got {item}")
        finding = parsed(Finding, entry, where)
        _check_shape(self.claims[name], finding, where)
        self.found[name] = finding

    def judge(
        self,
        name: str,
        judge: Callable[..., Mapping[str, Any]],
        *samples: np.ndarray,
        paired: bool = False,
        fixed: bool = False,
        **fields: Any,
    ) -> dict[str, Any]:
        """Adds what `judge(*samples)` finds, with how firm the verdict is; returns what it found.

        judge    a function of `report.judges` or of a study's judgements, or a partial of one
        paired, fixed  how the samples are resampled, see `report.firmness`
        fields   further fields of `Finding`; they take precedence
        """
        if name not in self.claims:
            raise UserError(f"{self.notebook}: {name} is not one of its claims; they are {', '.join(self.claims)}")
        claim, found = self.claims[name], dict(judge(*samples)) | fields

        def judged(*resampled: np.ndarray) -> str:
            entry = {key: _plain(item) for key, item in (dict(judge(*resampled)) | fields).items()}
            return verdict(claim, Finding(**entry | {"real_frames": True}), JUDGED)

        rng = np.random.default_rng(crc32(name.encode()))
        resamples = RESAMPLES if self.profile == JUDGED else FEW
        firm = firmness(judged, samples, rng, resamples, paired=paired, fixed=fixed)
        self.add(name, **found, judge=getattr(judge, "func", judge).__name__, firm=firm)
        return found

    def write(self, pending: Collection[str] = ()) -> Path:
        """Writes the results file, whole or not at all, and returns its path.

        pending  ids that this notebook does not compute or this profile leaves out; they read 'not run'

        Raises UserError if an id of this notebook is neither found nor pending, or both, if a pending id belongs to
        another notebook, and if the file cannot be written.
        """
        for name in pending:
            if name not in self.claims or name in self.found:
                reason = "was added" if name in self.found else "is not one of its claims"
                raise UserError(f"{self.notebook}: {name} is listed as pending but {reason}")
        missing = [name for name in self.claims if name not in self.found and name not in pending]
        if missing:
            raise UserError(f"{self.notebook}: no finding for {', '.join(missing)}; add it or list it as pending")
        entries = {
            name: self.found[name].model_dump() | {"verdict": verdict(claim, self.found[name], self.profile)}
            for name, claim in self.claims.items()
            if name in self.found
        }
        head = {"notebook": self.notebook, "profile": self.profile, "pending": sorted(pending)}
        content = {**head, "findings": entries}
        write_checked(self.path, content)
        return self.path


def _plain(item: Any) -> Any:
    """Numpy scalars and arrays as Python's own, also inside a list."""
    if isinstance(item, (list, tuple)):
        return [_plain(part) for part in item]
    return item.tolist() if hasattr(item, "tolist") else item


def _check_shape(claim: Claim, finding: Finding, where: str) -> None:
    """Raises UserError unless value and interval have shapes that fit the paper's and every needed test is there."""
    ours, paper = numbers(finding.value), numbers(claim.paper)
    alike = isinstance(finding.value, str) if paper is None else ours and len(paper) in (1, len(ours))
    if not alike:
        raise UserError(f"{where}: value {finding.value!r} is not comparable with the paper's {claim.paper!r}")
    if (finding.low is None) != (finding.high is None):
        raise UserError(f"{where}: low and high go together, got {finding.low} and {finding.high}")
    if finding.low is not None:
        _check_interval(finding, where)
    if claim.tested and finding.holds is None:
        raise UserError(f"{where}: holds must be True or False, because a measured claim needs a test that could fail")


def _check_interval(finding: Finding, where: str) -> None:
    """Raises UserError unless there is one low and one high end for each number of the value."""
    ours, lows, highs = (numbers(each) for each in (finding.value, finding.low, finding.high))
    if not len(lows) == len(highs) == len(ours or ()) or any(map(operator.gt, lows, highs)):
        raise UserError(
            f"{where}: expected low <= high for each number of the value, got {finding.low}, {finding.high}"
        )
