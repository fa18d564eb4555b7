"""Runtime of policy files, with numpy and onnxruntime only, for the robot's computer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors
from surefoot.native_output import stdout_to_stderr
from surefoot.policy.contract import Contract
from surefoot.policy.digest import check_digest
from surefoot.policy.network import INPUT, MAX_BYTES, OUTPUT, check_network
from surefoot.robot import RobotDescription
from surefoot.robot.archive import unpack_robot

with stdout_to_stderr():
    # onnxruntime warns of unknown processors and devices while it is loaded, not only when it is used.
    import onnxruntime


class PolicyRuntime:
    """A policy file, loaded and checked: readings in SI units in, feedback in leg space out.

    Make it with `load`.
    """

    def __init__(self, session: onnxruntime.InferenceSession, contract: Contract, robot: bytes = b"") -> None:
        self._session, self.contract, self._robot = session, contract, robot
        self._low, self._high = np.array(contract.low), np.array(contract.high)

    @classmethod
    def load(cls, path: str | Path) -> PolicyRuntime:
        """Load a policy file.

        Raises:
            SurefootError: the file is missing, damaged, no policy, of another schema, different from its contract, or
                changed since it was exported.
        """
        path = Path(path)
        with describe_os_errors(f"policy file {path}"), path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        with prefix_errors(f"policy file {path}"):
            return cls.parse(data)

    @classmethod
    def parse(cls, data: bytes) -> PolicyRuntime:
        """Check the bytes of a policy file and load them.

        Raises:
            SurefootError: as `load`.
        """
        if not data:
            raise SurefootError("is empty; a policy is an ONNX file that surefoot exported")
        try:
            # Nothing of a file is run before all of this has passed.
            parts = check_digest(data)
            check_network(parts.graph)
            contract = Contract.from_json(parts.contract.decode())
        except (UnicodeDecodeError, OverflowError, RecursionError) as error:
            raise SurefootError(str(error)) from error
        try:
            with stdout_to_stderr():
                session = onnxruntime.InferenceSession(data, _options(), providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no common class of their own.
            reason = " ".join(str(error).split()).rsplit(" : ", 1)[-1]
            raise SurefootError(f"is damaged or not ONNX: {reason}") from error
        _check_tensor("input", session.get_inputs(), INPUT, contract.width)
        _check_tensor("output", session.get_outputs(), OUTPUT, len(contract.action_names))
        robot = parts.robot_archive()
        if not robot and not contract.description:
            raise SurefootError(f"lacks its robot '{contract.robot}', which does not ship; export it again")
        return cls(session, contract, robot)

    def load_robot(self, robot: str | None = None) -> RobotDescription:
        """Return the robot to run on: by name or folder, else the one that the file carries, else its own that ships.

        Raises:
            SurefootError: no such robot, or an invalid one.
        """
        if robot is None and self._robot:
            with prefix_errors(f"policy '{self.contract.name}'"):
                return RobotDescription.load(unpack_robot(self._robot))
        return RobotDescription.load(robot or self.contract.description)

    def feedback(self, observation: ArrayLike) -> Array:
        """Return the feedback (N, A) within the contract's bounds for observations (N, O * history).

        Raises:
            SurefootError: observations of another shape, or a number that is not finite, in or out.
        """
        inputs = np.asarray(observation, np.float32)
        if inputs.ndim != 2 or inputs.shape[1] != self.contract.width:
            raise SurefootError(f"observation has shape {inputs.shape}; this policy takes (N, {self.contract.width})")
        if not np.isfinite(inputs).all():
            column = int(np.argwhere(~np.isfinite(inputs))[0][1]) % len(self.contract.columns)
            raise SurefootError(
                f"observation '{self.contract.columns[column]}' is not finite; every reading must be a number"
            )
        (raw,) = self._session.run(None, {INPUT: np.ascontiguousarray(inputs)})
        if not np.isfinite(raw).all():
            raise SurefootError(f"policy '{self.contract.name}' gave feedback that is not finite; it can't be run")
        # 32-bit numbers may miss a bound by a rounding.
        bounded: Array = np.clip(np.asarray(raw, np.float64), self._low, self._high)
        return bounded


def _options() -> onnxruntime.SessionOptions:
    """Return session options with one thread and no output: a second thread does not pay for so small a network."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4
    # Otherwise onnxruntime would run a file in its own format that is hidden in this one, and was not checked.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    return options


def _check_tensor(end: str, tensors: list[Any], name: str, width: int) -> None:
    """Refuse inputs or outputs that are not one tensor (N, width) of 32-bit numbers."""
    match tensors:
        case [tensor] if tensor.name == name and tensor.type == "tensor(float)":
            if len(tensor.shape) == 2 and tensor.shape[1] == width and not isinstance(tensor.shape[0], int):
                return
    actual = ", ".join(f"{tensor.name} {tensor.type} {tensor.shape}" for tensor in tensors)
    raise SurefootError(f"{end} is {actual}; its contract says {name} tensor(float) ['N', {width}]")
