"""Runs a policy file: numpy and onnxruntime only, so that the robot's computer can."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

from surefoot.errors import SurefootError
from surefoot.policy.contract import METADATA_KEY, Contract
from surefoot.policy.digest import check_digest


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
        try:
            data = path.read_bytes()
        except OSError as error:
            raise SurefootError(f"policy file {path}: can't be read: {error.strerror}") from error
        if not data:
            raise SurefootError(f"policy file {path}: is empty; a policy is an ONNX file that surefoot exported")
        try:
            session = onnxruntime.InferenceSession(data, _options(), providers=["CPUExecutionProvider"])
            metadata = session.get_modelmeta().custom_metadata_map
        except Exception as error:  # onnxruntime's errors have no common class of their own.
            reason = " ".join(str(error).split()).rsplit(" : ", 1)[-1]
            raise SurefootError(f"policy file {path}: is damaged or not ONNX: {reason}") from error
        if METADATA_KEY not in metadata:
            raise SurefootError(f"policy file {path}: has no contract; surefoot runs only policies that it exported")
        try:
            contract = Contract.from_json(metadata[METADATA_KEY])
        except SurefootError as error:
            raise SurefootError(f"policy file {path}: {error}") from error
        for what, found, name, width in (
            ("input", session.get_inputs(), "observation", contract.width),
            ("output", session.get_outputs(), "feedback", len(contract.action_names)),
        ):
            _check_end(path, what, found, name, width)
        try:
            digest = check_digest(data)
        except SurefootError as error:
            raise SurefootError(f"policy file {path}: {error}") from error
        return cls(session, contract, digest)

    def feedback(self, observation: ArrayLike) -> NDArray[np.float64]:
        """Feedback (N, 2 L) [rad] within the contract's bounds for observations (N, O * history) in SI.

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
        (raw,) = self._session.run(None, {"observation": np.ascontiguousarray(given)})
        if not np.isfinite(raw).all():
            raise SurefootError(f"policy '{self.contract.name}' gave feedback that is not finite; it can't be run")
        # 32-bit numbers may miss a bound by a rounding.
        bounded: NDArray[np.float64] = np.clip(np.asarray(raw, np.float64), self._low, self._high)
        return bounded


def _options() -> onnxruntime.SessionOptions:
    """One thread, nothing on stderr: a network this small is done before a second thread has woken."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4
    return options


def _check_end(path: Path, what: str, found: list[Any], name: str, width: int) -> None:
    """Refuse what is not one tensor (N, width) of 32-bit numbers, as the contract tells."""
    said = ", ".join(f"{end.name} {end.type} {end.shape}" for end in found)
    fits = len(found) == 1 and found[0].name == name and found[0].type == "tensor(float)"
    if not (
        fits and len(found[0].shape) == 2 and found[0].shape[1] == width and not isinstance(found[0].shape[0], int)
    ):
        raise SurefootError(
            f"policy file {path}: {what} is {said}; its contract says {name} tensor(float) ['N', {width}]"
        )
