"""Settings: precedence, and errors that name the setting."""

import pytest

from embomatrix.starter.shipped import demo_settings
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import SERVER_TRUNCATE_RATIO, read_settings


def test_file_overrides_defaults_and_options_override_the_file(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text("seed = 3\n[grpo]\ngroup = 4\nchunk = 2\n")
    settings = read_settings(
        path, {"grpo.chunk": 1, "grpo.steps": None}, {"grpo.group": 6, "grpo.max_new": 9}
    )
    assert (settings.seed, settings.grpo.group, settings.grpo.chunk, settings.grpo.max_new) == (3, 4, 1, 9)


def test_settings_of_the_demo_sample_as_many_plans_as_the_defaults_and_need_no_reference():
    demo, defaults = (read_settings(path, {}).grpo for path in (demo_settings(), None))
    assert demo.tasks_per_step * demo.group == defaults.tasks_per_step * defaults.group
    assert demo.chunk * 2 == demo.tasks_per_step  # each of two processes has a microbatch
    assert demo.kl_coef == 0


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("speed = 3", r"unknown setting 'speed': correct its name"),
        ("[grpo]\nspeed = 3", r"unknown setting 'grpo\.speed'"),
        (
            "[grpo]\ngroup = 1",
            r"setting 'grpo\.group': input should be greater than or equal to 2 \(found 1\)",
        ),
        (
            "[grpo]\nupdates_per_batch = 0",
            r"'grpo\.updates_per_batch': input should be .* equal to 1 \(found 0\)",
        ),
        (
            "[grpo]\ntasks_per_step = 4\nminibatches = 5",
            r"'grpo\.minibatches': expected at most 4, the value of grpo\.tasks_per_step, .* \(found 5\)",
        ),
        ("[grpo]\noverlong = 'drop'", r"'grpo\.overlong': input should be 'keep' or 'mask' \(found 'drop'\)"),
        (
            "[grpo]\ntruncate_ratio = 2",
            r"'grpo\.truncate_ratio': expected none \(found 2\), .* grpo\.overlap = 'stream': leave it out",
        ),
        (
            "[grpo]\noverlap = 'ahead'\ntruncate_ratio = 0.5",
            r"'grpo\.truncate_ratio': .* equal to 1 \(found 0\.5\)",
        ),
        (
            "device = 'cuda'\nprocesses = 2",
            r"'device': expected cpu with processes = 2, .*: set processes to 1, or leave the device out",
        ),
        *(
            (
                f"[sampler]\nurl = '{url}'",
                r"'sampler\.url': expected an address such as http://127\.0\.0\.1:8000 \(found '",
            )
            for url in ("localhost:8000", "http://", "http://localhost:80000", "http://[::1:8000")
        ),
        (
            "processes = 2\n[sampler]\nurl = 'http://localhost:8000'",
            r"'processes': expected 1 with sampler\.url, .* \(found 2\): leave one of them out",
        ),
        ("[reward]\ngaol = 3", r"unknown setting 'reward\.gaol': correct its name"),
        ("[reward]\ngoal = -3", r"setting 'reward': .*goal: found -3: expected 0 or more"),
        ("[reward]\ngoal = 'much'", r"setting 'reward\.goal': input should be a valid number"),
        ("grpo = 3", r"setting 'grpo': expected a table of settings \(found 3\)"),
        ("[grpo", r"settings\.toml is not valid TOML"),
        ("a = " + "[" * 5_000, r"settings\.toml is not valid TOML \(.*recursion"),
    ],
)
def test_invalid_settings_are_rejected(tmp_path, content, sentence):
    (tmp_path / "settings.toml").write_text(content)
    with pytest.raises(TrainerError, match=sentence):
        read_settings(tmp_path / "settings.toml", {"grpo.minutes": 1})


def test_missing_settings_file_is_reported(tmp_path):
    with pytest.raises(
        TrainerError, match=r"can't be read \(No such file or directory\): expected a TOML file"
    ):
        read_settings(tmp_path / "none.toml", {})


def test_model_server_turns_truncated_importance_sampling_on():
    url = "http://localhost:8000/v1/"
    settings = read_settings(None, {"sampler.url": url})
    assert settings.sampler.url == "http://localhost:8000"
    assert settings.grpo.truncate_ratio == SERVER_TRUNCATE_RATIO
    assert read_settings(None, {"sampler.url": url, "grpo.truncate_ratio": 5}).grpo.truncate_ratio == 5
    assert read_settings(None, {}).grpo.truncate_ratio is None
