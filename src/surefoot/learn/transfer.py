"""Warm starts: another run's networks as the first ones of a new run, whose inputs and outputs may differ."""

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
    "observations",  # what the policy observes
    "history",  # how many past ones it observes
    "reference",  # whether it has a phase; bounds of the feedback beside a reference that serves any robot
    "feedback",  # bounds, which say what actions mean
    "randomize",  # parameters that the critic observes
    "pushes",  # forces that the critic observes
    "terrain",  # heights that the critic observes
    "reward",  # follows the reference: a weight of foothold_error needs the reference's footholds
)
"""Fields of a task that change what networks observe or what their outputs mean, and that a warm start may change. Of
the robot, the action, the memory and the commands, which do that too, the other run's are taken to be the same."""

Parameters = Mapping[str, torch.Tensor]
"""Parameters of a network, by name."""
Input = tuple[int, str]
"""Age [control steps] and name of a number that a network observes; `PRIVILEGED` in place of an age, if only the critic
observes it."""
PRIVILEGED = -1


class Network(NamedTuple):
    """A network and what it observes."""

    parameters: Parameters
    inputs: Sequence[Input]


def warm_start(learner: PpoLearner, path: Path, make_world: SimulationFactory) -> None:
    """Give a new run the networks of another one, so that actions stay what they were.

    Inputs are matched by name and age. What only the critic observes may be missing; the policy's inputs may not. A
    network of another architecture is made of the policy that was evaluated best, as that part does not learn any more.

    Args:
        learner: of the new run.
        path: folder of the other run.
        make_world: makes the simulation.

    Raises:
        SurefootError: no run folder; networks of other layers, actions or architectures; an observation that is not
            made any more.
    """
    config, env, algorithm = learner.config, learner.env, learner.algorithm
    folder, former = RunFolder.open(path)
    task = replace(config.task, **{name: getattr(former.task, name) for name in NETWORK_FIELDS})
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
    """Return what the networks of a run in an environment observe, `actor` and `critic`."""
    policy = [(age, name) for age in range(env.task.history) for name in env.observer.columns]
    privileged = [(PRIVILEGED, name) for name in env.privileged_columns] if privileged_critic else []
    return {"actor": policy, "critic": policy + privileged}


def _convert_actor(state: Mapping[str, Any], fresh: Parameters, other: LocomotionEnv, env: LocomotionEnv) -> Parameters:
    """Return the policy of another run's state in this run's architecture and bounds, with the inputs as they were."""
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
    return architecture.adopt(fresh, actor)


def scale_output(actor: Parameters, old: tuple[Array, Array], new: tuple[Array, Array]) -> dict[str, torch.Tensor]:
    """Return a policy whose normalized actions mean the same feedback between other bounds.

    An action a in [-1, 1] means the feedback low + (a + 1) (high - low) / 2, so a' = a half / half' + (middle -
    middle') / half', where half is half the distance of the bounds. The last layer of each of its networks is scaled.

    Args:
        actor: parameters of the policy.
        old: its lower and upper bounds (A,) of the feedback.
        new: the bounds of the policy to return; where they are equal, nothing is scaled.
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
    """Return a network's parameters for other inputs, with the outputs as they were.

    A new input has weights of 0, and the normalization that the other run's critic has for an input of its name, or
    for the nearest point of its map of heights; else that of a fresh network. A first layer whose width is not that of
    the inputs stays as it is.

    Args:
        network: the network.
        fresh: a new network with the inputs that are wanted.
        critic: the other run's critic, which normalizes more inputs.
    """
    places = {one: k for k, one in enumerate(network.inputs)}
    kept = [k for k, one in enumerate(fresh.inputs) if one in places]
    taken = [places[fresh.inputs[k]] for k in kept]
    sources = _normalized_inputs(fresh, critic)
    moved = dict(network.parameters)
    for key, start in fresh.parameters.items():
        normalizes = key.startswith("obs_normalizer") and start.dim() == 2
        if not (normalizes or key.endswith(".0.weight")) or moved[key].shape != (len(start), len(network.inputs)):
            continue
        moved[key] = start.clone() if normalizes else torch.zeros_like(start)
        if normalizes:
            moved[key][:, list(sources)] = critic.parameters[key][:, list(sources.values())]
        moved[key][:, kept] = network.parameters[key][:, taken]
    return moved


def _normalized_inputs(fresh: Network, critic: Network) -> dict[int, int]:
    """Return the places of a network's inputs that a critic normalizes, and their places among the critic's inputs."""
    if critic.parameters["mlp.0.weight"].shape[1] != len(critic.inputs):
        return {}
    known, near = {name: k for k, (_, name) in enumerate(critic.inputs)}, POLICY_GRID.nearest(CRITIC_GRID)
    alike = {k: name if name in known else near.get(name, name) for k, (_, name) in enumerate(fresh.inputs)}
    return {k: known[name] for k, name in alike.items() if name in known}
