"""Runtime of policy files, with numpy and onnxruntime only, for the robot's computer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError, accessible
from surefoot.native_output import stdout_to_stderr
from surefoot.policy.contract import METADATA_KEY, Contract
from surefoot.policy.digest import check_digest, read_parts
from surefoot.policy.network import INPUT, MAX_BYTES, OUTPUT, check_network

with stdout_to_stderr():
    # It warns of processors and devices that it does not know while it is loaded, not only when it is used.
    import onnxruntime


class PolicyRuntime:
    """A policy file, loaded and checked: raw readings in SI units in, leg-space feedback in radians out.

    Make it with `load`.
    """

    def __init__(self, session: onnxruntime.InferenceSession, contract: Contract, digest: str | None = None) -> None:
        self._session, self.contract = session, contract
        self.digest = digest
        """What shows that network and contract belong together; None for files written before there was one."""
        self._low, self._high = np.array(contract.low), np.array(contract.high)

    @classmethod
    def load(cls, path: str | Path) -> PolicyRuntime:
        """Load a policy file.

        Raises:
            SurefootError: the file is missing, damaged, no policy, of another schema, not what its
                contract says, or changed since it was exported.
        """
        path = Path(path)
        with accessible(f"policy file {path}"), path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if not data:
            raise SurefootError(f"policy file {path}: is empty; a policy is an ONNX file that surefoot exported")
        try:
            contract, digest = _read(data)
        except (ValueError, OverflowError, RecursionError) as error:
            raise SurefootError(f"policy file {path}: {error}") from error
        try:
            with stdout_to_stderr():
                session = onnxruntime.InferenceSession(data, _options(), providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no common class of their own.
            reason = " ".join(str(error).split()).rsplit(" : ", 1)[-1]
            raise SurefootError(f"policy file {path}: is damaged or not ONNX: {reason}") from error
        for what, found, name, width in (
            ("input", session.get_inputs(), INPUT, contract.width),
            ("output", session.get_outputs(), OUTPUT, len(contract.action_names)),
        ):
            _check_end(path, what, found, name, width)
        return cls(session, contract, digest)

    def feedback(self, observation: ArrayLike) -> Array:
        """Return the feedback (N, 2 L) [rad] within the contract's bounds for observations (N, O * history) in SI.

        Raises:
            SurefootError: observations of another shape, or a number not finite going in or coming out.
        """
        given = np.asarray(observation, np.float32)
        if given.ndim != 2 or given.shape[1] != self.contract.width:
            raise SurefootError(f"observation has shape {given.shape}; this policy takes (N, {self.contract.width})")
        if not np.isfinite(given).all():
            column = int(np.argwhere(~np.isfinite(given))[0][1]) % len(self.contract.columns)
            raise SurefootError(
                f"observation '{self.contract.columns[column]}' is not finite; every reading must be a number"
            )
        (raw,) = self._session.run(None, {INPUT: np.ascontiguousarray(given)})
        if not np.isfinite(raw).all():
            raise SurefootError(f"policy '{self.contract.name}' gave feedback that is not finite; it can't be run")
        # 32-bit numbers may miss a bound by a rounding.
        bounded: Array = np.clip(np.asarray(raw, np.float64), self._low, self._high)
        return bounded


def _read(data: bytes) -> tuple[Contract, str | None]:
    """Return the contract and digest of a policy file, checked with its network before any of it is run.

    Raises:
        SurefootError, ValueError, OverflowError, RecursionError: the file does not hold a policy.
    """
    parts = read_parts(data)
    if METADATA_KEY not in parts.properties:
        raise SurefootError("has no contract; surefoot runs only policies that it exported")
    digest = check_digest(data)
    check_network(parts.graph)
    return Contract.from_json(parts.properties[METADATA_KEY].decode()), digest


def _options() -> onnxruntime.SessionOptions:
    """Return session options with one thread and no output: a second thread does not pay for so small a network."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4
    # Or else a file that has onnxruntime's own format hidden in it would be run as that, not as what was checked.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    return options


def _check_end(path: Path, what: str, found: list[Any], name: str, width: int) -> None:
    """Refuse what is not one tensor (N, width) of 32-bit numbers, as the contract states."""
    said = ", ".join(f"{end.name} {end.type} {end.shape}" for end in found)
    fits = len(found) == 1 and found[0].name == name and found[0].type == "tensor(float)"
    if not (
        fits and len(found[0].shape) == 2 and found[0].shape[1] == width and not isinstance(found[0].shape[0], int)
    ):
        raise SurefootError(
            f"policy file {path}: {what} is {said}; its contract says {name} tensor(float) ['N', {width}]"
        )
