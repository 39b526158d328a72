"""`openjax export --policy open --format onnx --out DIR`: a policy for programs that
don't know openjax.

All formats hold the mean policy of a whole team, predictor included: from the
observation's arrays to actions (N, 4) in -1..1: collective thrust, roll, pitch and yaw
rate; with `--own`, that of one pursuer, as a vehicle computes it on board. The result
is compared with the policy itself before it is written.
"""

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from openjax.command_line import output_console, parse
from openjax.errors import UserError
from openjax.files import check_output_folder, replacing
from openjax.ranges import Interval, Seed
from openjax.show.progress import Steps
from openjax.store import DEFAULT_POLICY

PROGRAM = "openjax export"
TOLERANCE = 2e-5
"""Largest difference of an action that is put down to the order of sums."""
STEPS = {"flying games to compare on": 20.0, "writing and comparing": 10.0}
"""Seconds of each on a laptop, about."""
NAMES = {"onnx": "policy.onnx", "jax": "policy.jax_export", "c": "policy.c"}
EACH = (
    "self_state",
    "others",
    "pillars",
    "pillar_seen",
    "privileged",
    "position",
    "heading",
    "active",
    "others_there",
)
"""Fields that each pursuer sees for itself; the rest of an observation is the team's."""


@dataclass(frozen=True)
class ExportCommand:
    """Write a policy as ONNX, as a serialised JAX function, or as C."""

    policy: str = DEFAULT_POLICY
    """A run's directory, a policy file (.npz), or the name of a policy in the package."""
    format: Literal["onnx", "jax", "c"] = "onnx"
    """onnx: for onnxruntime and its kin (pip install onnx onnxruntime); jax: for
    jax.export.deserialize; c: C99.
    """
    own: bool = False
    """One pursuer's action instead of the whole team's."""
    out: Path = Path("exported")
    """Folder to write to."""
    observations: Annotated[int, Interval("[1, 100000000]")] = 10_000
    """Number of observations of its game on which it is compared."""
    seed: Seed = 0
    """Draws those observations."""


def observations(policy, number: int, seed: int) -> dict:
    """{field: array (number or more, ...)} of observations from games that the policy
    plays, NumPy.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from openjax.pursuit import Pursuit

    settings = dataclasses.replace(policy.settings.environment, physics="rigid", vehicles=())
    environment = Pursuit(settings)
    worlds = 64
    steps = -(-number // worlds)  # rounded up
    reset = jax.jit(jax.vmap(environment.reset))
    observation, state = reset(jax.random.split(jax.random.key(seed), worlds))

    @jax.jit
    def play(observation, state, key):
        def step(carry, key):
            observation, state = carry
            # some noise, or all worlds would soon look alike
            noise = 0.3 * jax.random.normal(key, state.previous_action.shape)
            action = jnp.clip(policy(observation) + noise, -1.0, 1.0)
            next_observation, state, *_ = jax.vmap(environment.step, in_axes=(None, 0, 0))(
                key, state, action
            )
            return (next_observation, state), observation

        return jax.lax.scan(step, (observation, state), jax.random.split(key, steps))[1]

    sample = play(observation, state, jax.random.key(seed + 1))
    fields = {}
    for field in dataclasses.fields(sample):
        array = getattr(sample, field.name)
        if array is not None:
            # steps and worlds in one axis
            fields[field.name] = np.asarray(array).reshape(-1, *array.shape[2:])
    return fields


def export(arguments: ExportCommand, tell: Callable[[str], None] = lambda step: None) -> dict:
    """Write the files; returns what FORMAT.json says. `tell` hears the steps. Raises
    UserError if it can't be, or differs.
    """
    import jax

    from openjax.pursuit import Observation
    from openjax.store.policies import load_policy

    check_output_folder(arguments.out, "--out")
    policy = load_policy(arguments.policy)
    playing, comparing = STEPS
    tell(playing)
    samples, reference_actions = _samples(policy, arguments)
    inputs = {
        name: jax.ShapeDtypeStruct(array.shape[1:], array.dtype) for name, array in samples.items()
    }
    tell(comparing)
    write = {"onnx": _onnx, "jax": _jax, "c": _c}[arguments.format]

    def act(**fields):
        return policy(Observation(**fields))

    draws = _draws(policy)
    files, actions, extra = write(act, inputs, samples, (policy.source, draws))
    report = {
        "policy": policy.source,
        "format": arguments.format,
        "file": NAMES[arguments.format],
        "bytes": len(files[NAMES[arguments.format]]),
        "observations": len(reference_actions),
        "largest_difference": _difference(actions, reference_actions, policy.source),
        "output": {"action": [int(n) for n in reference_actions.shape[1:]]},
        **({} if draws is None else _describe_draws(draws)),
        **extra,
    }
    files[f"{arguments.format}.json"] = (json.dumps(report, indent=1) + "\n").encode()
    for name, data in files.items():
        with replacing(arguments.out / name) as partial:
            partial.write_bytes(data)
    return report


def _draws(policy):
    """The rule by which the policy's team draws its strategies; None if it has one. Raises
    UserError if the draw depends on what the team sees.
    """
    from openjax.export.c_program import DrawnStrategies

    settings = policy.settings.environment
    if settings.strategies == 1:
        return None
    if settings.strategy_odds_unseen:
        raise UserError(
            f"policy {policy.source} has other odds while nobody sees the evader, which an "
            "exported policy can't have; mix it without --odds_unseen"
        )
    steps = min(settings.strategy_steps, settings.episode_length)
    seconds = round(steps * settings.time_step, 6)
    return DrawnStrategies(settings.strategies, steps, seconds, settings.strategy_odds)


def _describe_draws(draws) -> dict:
    return {
        "strategies": draws.strategies,
        "strategy_seconds": draws.seconds,
        "strategy_steps": draws.steps,
        "strategy": draws.in_words(),
    }


def _samples(policy, arguments):
    """Observations, and the policy's own actions on them."""
    import jax
    import numpy as np

    from openjax.pursuit import Observation

    samples = observations(policy, arguments.observations, arguments.seed)
    actions = np.asarray(jax.jit(jax.vmap(policy))(Observation(**samples)))
    if arguments.own:
        # the first pursuer's; all fly by the same networks
        actions = actions[:, :1]
        samples |= {name: samples[name][:, :1] for name in EACH if name in samples}
    return samples, actions


def _difference(actions, reference_actions, source):
    """The largest of an action; None where nothing was compared. Raises UserError for
    one too large.
    """
    if actions is None:
        return None
    difference = float(abs(actions - reference_actions).max())
    if not difference <= TOLERANCE:  # nor where it is no number
        raise UserError(
            f"the exported policy differs by {difference:.2g} from {source}: nothing was written"
        )
    return difference


def _describe(inputs) -> dict:
    return {
        name: {"shape": list(kind.shape), "type": str(kind.dtype)} for name, kind in inputs.items()
    }


def _onnx(act, inputs, samples, about):
    """The files, their actions on the sampled observations, and what to say about them."""
    import numpy as np

    from openjax.export.onnx_graph import onnx_model, size

    model = onnx_model(act, inputs, "action")
    try:
        import onnxruntime
    except ImportError as error:
        raise UserError("onnxruntime is missing: pip install onnx onnxruntime") from error
    data = model.SerializeToString()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    input_names = [value.name for value in session.get_inputs()]
    actions = []
    for i in range(len(samples["frames"])):
        actions += session.run(None, {name: np.asarray(samples[name][i]) for name in input_names})
    extra = {
        "inputs": _describe({name: inputs[name] for name in input_names}),
        "numbers": size(model),
        "nodes": len(model.graph.node),
    }
    return {NAMES["onnx"]: data}, np.stack(actions), extra


def _jax(act, inputs, samples, about):
    """See `_onnx`."""
    import jax
    import numpy as np

    program = jax.export.export(jax.jit(lambda fields: act(**fields)))(inputs)
    data = bytes(program.serialize())
    # compared is what was read back, not what was written
    call = jax.jit(jax.export.deserialize(bytearray(data)).call)
    actions = []
    for i in range(len(samples["frames"])):
        sample = {name: array[i] for name, array in samples.items()}
        actions.append(np.asarray(call(sample)))
    extra = {"inputs": _describe(inputs), "platforms": list(program.platforms)}
    return {NAMES["jax"]: data}, np.stack(actions), extra


def _c(act, inputs, samples, about):
    """See `_onnx`; nothing is compared where there is no C compiler."""
    from openjax.export.c_compiled import compile_c
    from openjax.export.c_program import c_program

    name = Path(NAMES["c"]).stem
    # for every C compiler, in a comment
    source, draws = about
    readable = Path(source).name.encode("ascii", "backslashreplace").decode()
    program = c_program(act, inputs, name, f"The policy {readable}", draws)
    extra = {
        "inputs": _describe(program.inputs),
        "numbers": program.numbers,
        "workspace_floats": program.workspace,
        "multiply_adds": program.multiply_adds,
        "functions": program.functions,
    }
    files = {f"{name}.c": program.source.encode(), f"{name}.h": program.header.encode()}
    call = compile_c(program, name)
    if call is None:
        return files, None, extra
    extra["microseconds"] = round(1e6 * call.seconds(), 1)
    return files, call(samples), extra


def main(arguments: Sequence[str]) -> None:
    """The command. Raises UserError for an unusable policy or folder."""
    options = parse(ExportCommand, ExportCommand(), arguments, PROGRAM)
    console = output_console()
    with Steps(f"exporting {options.policy}", STEPS, console) as steps:
        report = export(options, steps.begin)
    difference = report["largest_difference"]
    comparison = "not compared with the policy: there is no C compiler here"
    if difference is not None:
        comparison = f"differs by at most {difference:.1e} on {report['observations']} observations"
    console.print(
        f"{options.out / report['file']}: {report['bytes'] / 1e6:.2f} MB, {comparison}",
        soft_wrap=True,
    )
