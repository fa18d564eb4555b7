"""Warm starts: initialization of a run with the networks of another run, whose inputs and outputs may differ."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.learn.checkpoint_state import check_finite
from surefoot.learn.networks import find_architecture, load_parameters
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.learn.run_folder import RunFolder
from surefoot.task.env import LocomotionEnv, SimulationFactory
from surefoot.task.height_scan import CRITIC_GRID, POLICY_GRID

NETWORK_FIELDS = (
    "observations",  # inputs of the policy
    "history",  # number of past observations
    "reference",  # observation of its phase, and narrowed bounds of the feedback if it is relative
    "feedback",  # bounds that scale the actions
    "randomize",  # parameters that the critic observes
    "pushes",  # forces that the critic observes
    "terrain",  # heights that the critic observes
    "reward",  # a weight of foothold_error requires a reference with footholds
)
"""Fields of a task that affect the inputs of networks or the meaning of their outputs, and that may differ in a warm
start. The action and the memory must be the same as in the other run; the robot and the commands are assumed to be."""

Parameters = Mapping[str, torch.Tensor]
"""Parameters of a network, by name."""
Input = tuple[int, str]
"""Input of a network: age [control steps] and name of an observed column. The age is `PRIVILEGED` for privileged
observations of the critic."""
PRIVILEGED = -1


class Network(NamedTuple):
    """Parameters and inputs of a network."""

    parameters: Parameters
    inputs: Sequence[Input]


def warm_start(learner: PpoLearner, path: Path, make_world: SimulationFactory) -> None:
    """Initialize a new run with the networks of another run, without changing the policy's actions.

    Inputs are matched by name and age. Inputs of the policy must not be removed; inputs of the critic may. If the new
    run has another architecture, its frozen part is the other run's best evaluated policy.

    Args:
        learner: learner of the new run.
        path: folder of the other run.
        make_world: factory of the simulation.

    Raises:
        SurefootError: no run folder; networks of other layers, actions or architectures; or a missing observation.
    """
    config, env, algorithm = learner.config, learner.env, learner.algorithm
    folder, former = RunFolder.open(path)
    for name in ("action", "memory"):
        before, now = getattr(former.task, name), getattr(config.task, name)
        if before != now:
            raise SurefootError(f"start_from: the other run's {name} is {before}, this run's {now}; they must be equal")
    task = replace(config.task, reward_limits={}, **{name: getattr(former.task, name) for name in NETWORK_FIELDS})
    other, state, fresh = LocomotionEnv(task, 1, make_world, threads=1), folder.load(), algorithm.save()
    old, new = (network_inputs(one, config.ppo.privileged_critic) for one in (other, env))
    for age, name in old["actor"]:
        if (age, name) not in new["actor"]:
            raise SurefootError(
                f"start_from: the other run's policy observes {name}, {age} control steps old, which this run's "
                "does not; keep its observations and history, and add to them"
            )
    networks = dict(state["learner"]["algorithm"])
    critic = Network(networks["critic_state_dict"], old["critic"])
    networks["actor_state_dict"] = _convert_actor(state, fresh["actor_state_dict"], other, env)
    for part in ("actor", "critic"):
        key = f"{part}_state_dict"
        networks[key] = move_inputs(Network(networks[key], old[part]), Network(fresh[key], new[part]), critic)
        check_finite(networks[key], f"start_from: the other run's {key}")
    message = "start_from: the other run's networks do not fit this run"
    load_parameters(algorithm, networks, {"actor": True, "critic": True}, message)
    if config.ppo.start_std:
        with torch.no_grad():
            learner.policy.distribution.log_std_param.fill_(math.log(config.ppo.start_std))


def network_inputs(env: LocomotionEnv, privileged_critic: bool) -> dict[str, list[Input]]:
    """Return the inputs of the networks `actor` and `critic` in an environment."""
    policy = [(age, name) for age in range(env.task.history) for name in env.observer.columns]
    privileged = [(PRIVILEGED, name) for name in env.privileged_columns] if privileged_critic else []
    return {"actor": policy, "critic": policy + privileged}


def _convert_actor(state: Mapping[str, Any], fresh: Parameters, other: LocomotionEnv, env: LocomotionEnv) -> Parameters:
    """Convert the policy in another run's state to this run's architecture and bounds, with unchanged inputs."""
    architecture, former = find_architecture(env.task), find_architecture(other.task)
    if former not in (architecture, None):
        raise SurefootError(
            f"start_from: the other run's policy has the networks of {former.setting}, which this run's task lacks"
        )
    actor: Parameters = state["learner"]["algorithm"]["actor_state_dict"]
    if architecture is not former:
        actor = state["best_actor"] or actor
    if other.gait.action_names == env.gait.action_names:
        actor = scale_output(actor, (other.gait.low, other.gait.high), (env.gait.low, env.gait.high))
    if architecture is None or architecture is former:
        return actor
    return architecture.initial_parameters(fresh, actor)


def scale_output(actor: Parameters, old: tuple[Array, Array], new: tuple[Array, Array]) -> dict[str, torch.Tensor]:
    """Scale the outputs of a policy, so that it gives the same feedback between other bounds.

    An action a in [-1, 1] is the feedback low + (a + 1) (high - low) / 2. Hence a' = a half / half' + (middle -
    middle') / half', where half is half the distance between the bounds. The last layer of each network is scaled.

    Args:
        actor: parameters of the policy.
        old: lower and upper bounds of its feedback, (A,) each.
        new: lower and upper bounds of the returned policy. Outputs with equal bounds are not scaled.
    """
    half, wide = 0.5 * (old[1] - old[0]), 0.5 * (new[1] - new[0])
    scale = np.divide(half, wide, out=np.ones_like(half), where=wide > 0)
    shift = np.divide(old[0] + half - new[0] - wide, wide, out=np.zeros_like(half), where=wide > 0)
    factor, offset = torch.from_numpy(scale).float(), torch.from_numpy(shift).float()
    last: dict[str, int] = {}
    for name in actor:
        if name.startswith("mlp.") and name.endswith(".weight"):
            network, number, _ = name.rsplit(".", 2)
            last[network] = max(int(number), last.get(network, 0))
    scaled = dict(actor)
    for network, layer in last.items():
        weight, bias = f"{network}.{layer}.weight", f"{network}.{layer}.bias"
        scaled |= {weight: actor[weight] * factor[:, None], bias: actor[bias] * factor + offset}
    return scaled


def move_inputs(network: Network, fresh: Network, critic: Network) -> dict[str, torch.Tensor]:
    """Convert a network's parameters to other inputs, without changing its outputs.

    New inputs have zero weights. Their normalization comes from the other run's critic if that has an input of the same
    name or, for terrain heights, a nearby point; otherwise from a new network. First layers whose width differs from
    the number of inputs are not changed.

    Args:
        network: the network.
        fresh: a new network with the desired inputs.
        critic: critic of the other run, which normalizes more inputs.
    """
    places = {name: k for k, name in enumerate(network.inputs)}
    common = [k for k, name in enumerate(fresh.inputs) if name in places]
    former = [places[fresh.inputs[k]] for k in common]
    sources = _normalized_inputs(fresh, critic)
    moved = dict(network.parameters)
    for key, start in fresh.parameters.items():
        normalizes = key.startswith("obs_normalizer") and start.dim() == 2
        if not (normalizes or key.endswith(".0.weight")) or moved[key].shape != (len(start), len(network.inputs)):
            continue
        moved[key] = start.clone() if normalizes else torch.zeros_like(start)
        if normalizes:
            moved[key][:, list(sources)] = critic.parameters[key][:, list(sources.values())]
        moved[key][:, common] = network.parameters[key][:, former]
    return moved


def _normalized_inputs(fresh: Network, critic: Network) -> dict[int, int]:
    """Return the indices of inputs whose normalization a critic knows, mapped to indices of the critic's inputs."""
    if critic.parameters["mlp.0.weight"].shape[1] != len(critic.inputs):
        return {}
    indices, nearest = {name: k for k, (_, name) in enumerate(critic.inputs)}, POLICY_GRID.nearest(CRITIC_GRID)
    sources = {k: name if name in indices else nearest.get(name, name) for k, (_, name) in enumerate(fresh.inputs)}
    return {k: indices[name] for k, name in sources.items() if name in indices}
