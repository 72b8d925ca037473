"""Site files: what they may say, and what is said of those that are wrong."""

import pytest

from steadylight.errors import SettingsError
from steadylight.sites import SiteSettings, load_site, walltime_seconds


def written(tmp_path, text):
    path = tmp_path / "site.toml"
    path.write_text(text)
    return path


def test_a_site_file_is_read_and_its_certificates_are_beside_it(tmp_path):
    for name in ("ca", "own", "key"):
        (tmp_path / f"{name}.pem").touch()
    site = load_site(
        written(
            tmp_path,
            'queue = "long"\ncores = 16\nmemory = "60 GB"\nwalltime = "1-12:00:00"\nprologue = ["module load a"]\n'
            'maximum_workers = 40\n[tls]\nca = "ca.pem"\ncertificate = "own.pem"\nkey = "key.pem"\n'
            "[faults]\nstalled_after = 60\n",
        )
    )
    assert (site.queue, site.cores, site.maximum_workers) == ("long", 16, 40)
    assert site.tls.key == tmp_path / "key.pem"
    assert site.faults.stalled_after == 60
    assert site.for_jobs == ["cores", "maximum_workers", "memory", "prologue", "queue", "walltime"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("core = 4", r"site\.toml: core: unknown key; valid: queue, account, cores"),
        ("cores = 0", r"site\.toml: cores: 0 is not valid; input should be greater than 0"),
        ('memory = "60"', r'memory: \'60\' is not valid; give a number with its unit, such as "60 GB"'),
        ('walltime = "soon"', r"walltime: 'soon' is not valid; give hours, minutes and seconds"),
        ('prologue = ["a\\nb"]', r"prologue\.0: .* one line per list entry"),
        ('prologue = "module load a"', r"prologue: 'module load a' is not valid"),
        ("minimum_workers = 5\nmaximum_workers = 2", "minimum_workers is more than maximum_workers"),
        ("[faults]\nforgive = 3", r"faults\.forgive: unknown key; valid: stalled_after"),
        ('[tls]\nca = "a"\ncertificate = "b"\nkey = "c"', r"tls\.ca: no such file .*/a"),
        ('encrypted = false\n[tls]\nca = "a"\ncertificate = "b"\nkey = "c"', "but encrypted is false"),
        ('job_name = "two words"', "job_name: 'two words' is not valid"),
        ("queue = ", r"site\.toml: not TOML"),
    ],
)
def test_a_wrong_site_file_is_refused_with_file_key_and_remedy(tmp_path, text, message):
    with pytest.raises(SettingsError, match=message):
        load_site(written(tmp_path, text))


def test_a_site_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SettingsError, match=r"none\.toml: cannot be read"):
        load_site(tmp_path / "none.toml")


def test_nothing_set_means_nothing_for_jobs():
    assert SiteSettings().for_jobs == []


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("04:00:00", 14400), ("2-00:00:00", 172800), ("1-12", 129600), ("30", 1800), ("30:30", 1830)],
)
def test_walltimes_are_read_as_slurm_does(text, seconds):
    assert walltime_seconds(text) == seconds
