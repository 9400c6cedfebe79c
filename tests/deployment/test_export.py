"""Files that other programs run give what the agent gives."""

import json
import subprocess
import sys

import numpy as np
import onnxruntime
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded

from ls3_torchrl import LS3Agent
from ls3_torchrl.deployment import export_modules
from ls3_torchrl.modules.classifiers import probability_of

NAMES = ("encoder", "dynamics", "value", "safe_set", "constraint", "goal")


def agent(**options):
    torch.manual_seed(0)
    spec = Bounded(low=torch.tensor([-1.0, 0.0]), high=torch.tensor([1.0, 2.0]), shape=(2,))
    settings = {"constraint_threshold": 0.1}
    return LS3Agent(action_spec=spec, latent_dim=8, in_channels=6, planner=settings, task="mine", **options)


def inputs(name, rows):
    generator = torch.Generator().manual_seed(rows)
    latent = torch.randn(rows, 8, generator=generator)
    if name == "encoder":
        return (torch.randint(256, (rows, 6, 64, 64), generator=generator, dtype=torch.uint8),)
    return (latent, torch.randn(rows, 2, generator=generator)) if name == "dynamics" else (latent,)


@torch.no_grad()
def expected(agent, name, given):
    if name == "encoder":
        out = agent.encoder(TensorDict({"pixels": given[0]}, [len(given[0])]))
        return out["loc"], out["scale"]
    if name == "dynamics":
        return agent.dynamics.distribution(*given)
    if name == "value":
        return (agent.value.of_latent(given[0]),)
    return (probability_of(getattr(agent, name), given[0]),)


def as_tuple(outputs):
    return outputs if isinstance(outputs, tuple) else (outputs,)


@pytest.mark.parametrize("options", [{}, {"control_affine": True, "action_scale": "box"}])
def test_exported_modules_give_what_the_agent_gives(tmp_path, options):
    made = agent(**options)
    files = export_modules(made, tmp_path / "new" / "folder")
    assert tuple(files) == NAMES
    for name, path in files.items():
        module = torch.export.load(path).module()
        for rows in (1, 7):
            given = inputs(name, rows)
            for ours, theirs in zip(expected(made, name, given), as_tuple(module(*given)), strict=True):
                torch.testing.assert_close(theirs, ours, msg=f"{name}, {rows} rows")


def test_onnx_gives_what_the_agent_gives(tmp_path):
    made = agent(control_affine=True)
    described = None
    for name, path in export_modules(made, tmp_path, format="onnx").items():
        described = described or json.loads((tmp_path / "modules.json").read_text())["modules"]
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        assert [i.name for i in session.get_inputs()] == list(described[name]["inputs"])
        assert [o.name for o in session.get_outputs()] == list(described[name]["outputs"])
        for rows in (1, 7):
            given = inputs(name, rows)
            fed = {i.name: value.numpy() for i, value in zip(session.get_inputs(), given, strict=True)}
            for ours, theirs in zip(expected(made, name, given), session.run(None, fed), strict=True):
                np.testing.assert_allclose(theirs, ours.numpy(), rtol=1e-4, atol=1e-5, err_msg=f"{name}, {rows} rows")


def test_the_files_need_nothing_but_pytorch(tmp_path):
    made = agent()
    files = export_modules(made, tmp_path)
    code = (
        "import sys\n"
        "sys.modules.update({name: None for name in ('ls3_torchrl', 'torchrl', 'tensordict')})\n"
        "import torch\n"
        f"paths = {str(files['encoder'])!r}, {str(files['constraint'])!r}\n"
        "encoder, constraint = (torch.export.load(path).module() for path in paths)\n"
        "loc, scale = encoder(torch.full((3, 6, 64, 64), 99, dtype=torch.uint8))\n"
        "print(constraint(loc).flatten().tolist())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loc = expected(made, "encoder", (torch.full((3, 6, 64, 64), 99, dtype=torch.uint8),))[0]
    told = torch.tensor(json.loads(done.stdout)).unsqueeze(-1)
    torch.testing.assert_close(told, expected(made, "constraint", (loc,))[0])


def test_what_goes_in_and_out_is_described(tmp_path):
    made = agent()
    export_modules(made, tmp_path)
    described = json.loads((tmp_path / "modules.json").read_text())
    assert described["task"] == "mine"
    assert described["action"] == {"low": [-1.0, 0.0], "high": [1.0, 2.0]}
    assert described["constraint_threshold"] == 0.1
    assert described["safe_set_threshold"] == 0.8
    assert described["modules"]["encoder"] == {
        "file": "encoder.pt2",
        "inputs": {"pixels": ["uint8", "B", 6, 64, 64]},
        "outputs": {"loc": ["float32", "B", 8], "scale": ["float32", "B", 8]},
    }
    assert described["modules"]["dynamics"]["outputs"]["loc"] == ["float32", "B", 5, 8]


def test_an_agent_in_half_precision_is_exported_in_float32_and_left_as_it_is(tmp_path):
    made = agent().to(torch.bfloat16)
    files = export_modules(made, tmp_path)
    assert {parameter.dtype for parameter in made.parameters()} == {torch.bfloat16}
    given = inputs("value", 4)
    torch.testing.assert_close(
        torch.export.load(files["value"]).module()(*given), expected(made.float(), "value", given)[0]
    )


def test_what_cannot_be_exported_is_refused(tmp_path, monkeypatch):
    own = TensorDictModule(torch.nn.Linear(8, 1), in_keys=["latent"], out_keys=["constraint_logit"])
    with pytest.raises(ValueError, match="constraint came from outside"):
        export_modules(agent(constraint=own), tmp_path)
    with pytest.raises(ValueError, match="format"):
        export_modules(agent(), tmp_path, format="tflite")
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'ls3-torchrl\[deployment\]'"):
        export_modules(agent(), tmp_path, format="onnx")
    assert not list(tmp_path.iterdir())
