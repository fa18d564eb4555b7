"""Runtime of policy files for the robot's computer, which needs only numpy and onnxruntime."""

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
    # onnxruntime prints warnings about unknown processors and devices when it is imported, not only when it is used.
    import onnxruntime


class PolicyRuntime:
    """Loaded policy file, which maps observations in SI units to feedback in leg space. Create it with `load`."""

    def __init__(self, session: onnxruntime.InferenceSession, contract: Contract, robot: bytes = b"") -> None:
        self._session, self.contract, self._robot = session, contract, robot
        self._low, self._high = np.array(contract.low), np.array(contract.high)

    @classmethod
    def load(cls, path: str | Path) -> PolicyRuntime:
        """Load a policy file.

        Raises:
            SurefootError: the file is missing, damaged, not a policy, of another schema, inconsistent with its
                contract, or changed since it was exported.
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
            SurefootError: as in `load`.
        """
        if not data:
            raise SurefootError("is empty; a policy is an ONNX file that surefoot exported")
        try:
            # No part of a file is run before all these checks have passed.
            parts = check_digest(data)
            check_network(parts.graph)
            contract = Contract.from_json(parts.contract.decode())
        except (UnicodeDecodeError, OverflowError, RecursionError) as error:
            raise SurefootError(str(error)) from error
        try:
            with stdout_to_stderr():
                session = onnxruntime.InferenceSession(data, _options(), providers=["CPUExecutionProvider"])
        except Exception as error:  # errors of onnxruntime have no common base class
            reason = " ".join(str(error).split()).rsplit(" : ", 1)[-1]
            raise SurefootError(f"is damaged or not ONNX: {reason}") from error
        _check_tensor("input", session.get_inputs(), INPUT, contract.width)
        _check_tensor("output", session.get_outputs(), OUTPUT, len(contract.action_names))
        robot = parts.robot_archive()
        if not robot and not contract.description:
            raise SurefootError(f"lacks its robot '{contract.robot}', which is not built in; export the policy again")
        return cls(session, contract, robot)

    def load_robot(self, robot: str | None = None) -> RobotDescription:
        """Load the robot to run on: the named robot or folder, or by default the policy's own robot.

        Raises:
            SurefootError: the robot does not exist or is invalid.
        """
        if robot is None and self._robot:
            with prefix_errors(f"policy '{self.contract.name}'"):
                return RobotDescription.load(unpack_robot(self._robot))
        return RobotDescription.load(robot or self.contract.description)

    def feedback(self, observation: ArrayLike) -> Array:
        """Return the feedback (N, A), within the contract's bounds, for observations (N, O * history).

        Raises:
            SurefootError: the observations have another shape, or inputs or outputs are not finite.
        """
        inputs = np.asarray(observation, np.float32)
        if inputs.ndim != 2 or inputs.shape[1] != self.contract.width:
            raise SurefootError(f"observation has shape {inputs.shape}; this policy takes (N, {self.contract.width})")
        if not np.isfinite(inputs).all():
            column = int(np.argwhere(~np.isfinite(inputs))[0][1]) % len(self.contract.columns)
            raise SurefootError(
                f"observation '{self.contract.columns[column]}' is not finite; all readings must be finite"
            )
        (raw,) = self._session.run(None, {INPUT: np.ascontiguousarray(inputs)})
        if not np.isfinite(raw).all():
            raise SurefootError(f"policy '{self.contract.name}' gave feedback that is not finite; it can't be run")
        # 32-bit floats may exceed a bound by a rounding error.
        bounded: Array = np.clip(np.asarray(raw, np.float64), self._low, self._high)
        return bounded


def _options() -> onnxruntime.SessionOptions:
    """Return session options with a single thread, which is fastest for such small networks, and without output."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4
    # Without this, onnxruntime would also accept its own file format, hidden in this file, which was not checked.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    return options


def _check_tensor(end: str, tensors: list[Any], name: str, width: int) -> None:
    """Reject inputs or outputs other than a single tensor (N, width) of 32-bit floats."""
    match tensors:
        case [tensor] if tensor.name == name and tensor.type == "tensor(float)":
            if len(tensor.shape) == 2 and tensor.shape[1] == width and not isinstance(tensor.shape[0], int):
                return
    actual = ", ".join(f"{tensor.name} {tensor.type} {tensor.shape}" for tensor in tensors)
    raise SurefootError(f"{end} is {actual}; its contract says {name} tensor(float) ['N', {width}]")
