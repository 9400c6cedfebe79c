"""Damaged agent files: what loads is what was saved, bit by bit; all else is one error that names the file."""

import pickle
import shutil
import threading
import warnings

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded

from ls3_torchrl import LS3Agent

D = 2


def encoder():
    return TensorDictModule(torch.nn.Linear(3, D), ["state"], ["latent"])


def tiny_agent():
    torch.manual_seed(0)
    hidden = {"dynamics_hidden": (3,), "value_hidden": (3,), "classifier_hidden": (3,)}
    spec = Bounded(-1.0, 1.0, shape=(1,))
    return LS3Agent(
        action_spec=spec,
        encoder=encoder(),
        latent_dim=D,
        num_dynamics=2,
        num_values=2,
        planner={"horizon": 3},
        **hidden,
    )


def load(path):
    return LS3Agent.load(path, modules={"encoder": encoder()})


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    agent = tiny_agent()
    return agent, agent.save(tmp_path_factory.mktemp("agent") / "agent.pt").read_bytes()


def same(one, other):
    weights = other.state_dict()
    return (
        one.architecture == other.architecture
        and one.planner_settings == other.planner_settings
        and torch.equal(one.action_spec.space.low, other.action_spec.space.low)
        and one.state_dict().keys() == weights.keys()
        and all(torch.equal(value, weights[name]) for name, value in one.state_dict().items())
    )


def check(path, agent):
    """What a damaged file may end in."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            loaded = load(path)
    except (ValueError, FileNotFoundError) as error:
        return str(path) in str(error) and "\n" not in str(error)
    return same(agent, loaded)


def test_a_part_that_is_marked_as_a_folder_is_found(tmp_path, saved):
    _, content = saved
    first = content.index(b"PK\x01\x02")  # the first entry of the archive's directory; its attributes follow
    damaged = bytearray(content)
    damaged[first + 38] ^= 0x10
    (tmp_path / "agent.pt").write_bytes(damaged)
    with pytest.raises(ValueError, match="marked as a folder"):
        load(tmp_path / "agent.pt")


@settings(max_examples=1500)
@given(where=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_anywhere_is_found_or_changes_nothing(tmp_path_factory, saved, where, bit):
    agent, content = saved
    damaged = bytearray(content)
    damaged[int(where * len(content))] ^= 1 << bit
    path = tmp_path_factory.getbasetemp() / "flipped.pt"
    path.write_bytes(damaged)
    assert check(path, agent)


@settings(max_examples=300)
@given(
    cut=st.floats(0, 1),
    tail=st.binary(max_size=40),
    at=st.floats(0, 1),
    middle=st.binary(max_size=40),
)
@example(cut=0.0, tail=b"", at=0.0, middle=b"")
@example(cut=1.0, tail=b"behind", at=0.0, middle=b"")
def test_a_file_that_was_cut_or_written_over_is_found(tmp_path_factory, saved, cut, tail, at, middle):
    agent, content = saved
    damaged = content[: int(cut * len(content))] + tail
    start = int(at * len(damaged))
    damaged = damaged[:start] + middle + damaged[start + len(middle) :]
    path = tmp_path_factory.getbasetemp() / "cut.pt"
    path.write_bytes(damaged)
    assert check(path, agent)


def rewritten(path, change):
    """The file with its content changed by a user, its checksums right."""
    content = torch.load(path, weights_only=True)
    change(content)
    torch.save(content, path)
    return path


@pytest.fixture
def path(saved, tmp_path):
    file = tmp_path / "agent.pt"
    file.write_bytes(saved[1])
    return file


WEIGHT = "value.network.weights.0"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["state_dict"].pop(WEIGHT), "weights in .* do not fit"),
        (lambda c: c["state_dict"].update(extra=torch.zeros(1)), "weights in .* do not fit"),
        (lambda c: c["state_dict"].update({WEIGHT: torch.zeros(1)}), "weights in .* do not fit"),
        (lambda c: c["state_dict"].update({WEIGHT: "text"}), "weights in .* do not fit"),
        (lambda c: c["state_dict"].update({WEIGHT: c["state_dict"][WEIGHT].double()}), f"{WEIGHT} in torch.float64"),
        (lambda c: c["state_dict"].update({WEIGHT: c["state_dict"][WEIGHT].half()}), f"{WEIGHT} in torch.float16"),
        (lambda c: c["state_dict"].update({WEIGHT: c["state_dict"][WEIGHT].long()}), f"{WEIGHT} in torch.int64"),
        (lambda c: c["state_dict"][WEIGHT].view(-1)[0].fill_(torch.nan), f"1 of 12 weights of {WEIGHT} are NaN"),
        (lambda c: c["state_dict"][WEIGHT].fill_(torch.inf), f"12 of 12 weights of {WEIGHT} are NaN or infinite"),
        (lambda c: c.pop("state_dict"), "without state_dict"),
        (lambda c: c.pop("architecture"), "without architecture"),
        (lambda c: c.update(architecture=[1]), "without architecture"),
        (lambda c: c.update(state_dict=None), "without state_dict"),
        (lambda c: c["architecture"].update(latent_dim=0), "settings that no agent can have"),
        (lambda c: c["architecture"].update(latent_dim="two"), "settings that no agent can have"),
        (lambda c: c["architecture"].update(tail=1), "settings that no agent can have"),
        (lambda c: c.update(action_spec={"low": torch.ones(1), "high": -torch.ones(1)}), "settings that no agent"),
        (lambda c: c.update(action_spec={"low": 3}), "settings that no agent"),
        (lambda c: c.update(format="another"), "not an agent file"),
        (lambda c: c.update(version=99), "has version 99"),
        (lambda c: c.update(version=None), "has version None"),
        (lambda c: c.update(foreign=["decoder"]), "modules from outside"),
    ],
)
def test_a_file_with_another_content_is_refused_by_name(path, change, message):
    with pytest.raises(ValueError, match=message) as caught:
        load(rewritten(path, change))
    assert str(path) in str(caught.value)


class Payload:
    """What runs when it is unpickled."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('code of a file was run')",))


def test_no_code_in_a_file_is_run(path):
    path.write_bytes(pickle.dumps(Payload()))
    with pytest.raises(ValueError, match="agent file"):
        load(path)
    torch.save({"format": "ls3_torchrl.agent", "version": 2, "state_dict": Payload()}, path)
    with pytest.raises(ValueError, match="agent file"):
        load(path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"# an agent\n", "ümläut".encode("latin-1"), b"\x80\x04."])
def test_a_file_of_another_kind_is_refused_by_name(path, content):
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"agent\.pt is not an agent file.*another copy"):
        load(path)


def test_a_folder_and_a_missing_file_are_told_apart(tmp_path):
    with pytest.raises(FileNotFoundError, match="it is a folder"):
        load(tmp_path)
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        load(tmp_path / "agent.pt")


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_an_agent_that_diverged_is_not_saved_over_one_that_did_not(path, saved, bad):
    agent = tiny_agent()
    with torch.no_grad():
        next(agent.dynamics.parameters()).view(-1)[0] = bad
    with pytest.raises(ValueError, match=r"not saved to .*weights of dynamics\.network.*before its training diverged"):
        agent.save(path)
    assert same(saved[0], load(path))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_a_whole_agent_of_another_precision_keeps_it(tmp_path, dtype):
    agent = tiny_agent().to(dtype)
    loaded = load(agent.save(tmp_path / "agent.pt"))
    assert same(agent, loaded)
    assert {p.dtype for p in loaded.parameters()} == {dtype}


@pytest.mark.parametrize(
    "sizes",
    [
        {"latent_dim": np.int64(3), "num_values": np.array(2), "action_scale": np.float32(1.5)},
        {"latent_dim": torch.tensor(3), "action_scale": torch.tensor([2.0]), "control_affine": np.bool_(True)},
        {"action_scale": np.float64(0.5), "value_hidden": np.array([4, 4]), "background": np.bool_(False)},
        {"dynamics_hidden": [np.int32(4)], "classifier_hidden": torch.tensor([4])},
    ],
)
def test_numbers_of_numpy_and_pytorch_are_kept_as_plain_ones(tmp_path, sizes):
    agent = LS3Agent(action_dim=np.int64(1), **({"latent_dim": 3} | sizes))
    loaded = LS3Agent.load(agent.save(tmp_path / "agent.pt"))
    assert loaded.architecture == agent.architecture


def test_two_saves_at_once_leave_one_of_the_two_whole(tmp_path):
    agents = [tiny_agent(), tiny_agent()]
    with torch.no_grad():
        next(agents[1].parameters()).add_(1.0)
    path = tmp_path / "agent.pt"
    for _ in range(10):
        threads = [threading.Thread(target=agent.save, args=(path,)) for agent in agents]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        loaded = load(path)
        assert same(agents[0], loaded) or same(agents[1], loaded)
    assert [file.name for file in tmp_path.iterdir()] == ["agent.pt"]


def test_a_save_that_fails_leaves_the_file_before_it_and_nothing_else(path, saved, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space left") as caught:
        tiny_agent().save(path)
    assert str(path) in str(caught.value)
    assert [file.name for file in path.parent.iterdir()] == ["agent.pt"]
    assert same(saved[0], load(path))


def test_a_file_can_be_moved(path, saved, tmp_path):
    shutil.move(path, tmp_path / "elsewhere.pt")
    assert same(saved[0], load(tmp_path / "elsewhere.pt"))


def test_a_compact_file_holds_what_acts_and_no_more(tmp_path):
    torch.manual_seed(0)
    agent = LS3Agent(action_spec=Bounded(-1.0, 1.0, shape=(2,)), latent_dim=4, planner={"horizon": 3}, background=True)
    whole, small = agent.save(tmp_path / "whole.pt"), agent.save(tmp_path / "small.pt", compact=True)
    assert small.stat().st_size < 0.3 * whole.stat().st_size
    loaded = LS3Agent.load(small)
    assert loaded.decoder is None
    assert loaded.planner().horizon == 3
    for name, weight in loaded.state_dict().items():
        before = agent.state_dict()[name]
        assert weight.dtype == before.dtype
        assert torch.equal(weight, before.to(torch.bfloat16).float() if before.is_floating_point() else before)
    again = loaded.save(tmp_path / "again.pt", compact=True)
    assert same(LS3Agent.load(again), loaded)
    assert same(LS3Agent.load(loaded.save(tmp_path / "whole_again.pt")), loaded)


def test_a_compact_file_asks_for_no_decoder_from_outside(tmp_path):
    decoder = TensorDictModule(torch.nn.Linear(D, 3), ["latent"], ["reco_state"])
    agent = LS3Agent(1, encoder=encoder(), decoder=decoder, latent_dim=D)
    assert load(agent.save(tmp_path / "small.pt", compact=True)).foreign == ("encoder",)
    with pytest.raises(ValueError, match="modules from outside: decoder, encoder"):
        load(agent.save(tmp_path / "whole.pt"))


@pytest.mark.parametrize("where", [0.1, 0.5, 0.9])
def test_damage_to_a_compact_file_is_found(tmp_path, where):
    path = tiny_agent().save(tmp_path / "small.pt", compact=True)
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"small\.pt"):
        load(path)
