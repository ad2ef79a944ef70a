//! `ksim planner import`: files as the reference implementation saves them become a run that plays the point mass.

use std::fs;
use std::path::Path;

use ksim_planners::nets::{
    Architecture, HalfJannerConfig, JannerConfig, TimestepEmbedding, initial_weights,
};

use crate::process::{Run, ksim};
use crate::torch_save::{StateDict, archive, torch_save};

const HORIZON: usize = 4;
/// Position and velocity, and an action.
const WIDTH: usize = 3;

struct Files(tempfile::TempDir);

impl Files {
    /// A dataset, and the networks of a Diffuser and of the curiosity.
    fn new() -> Self {
        let files = Self(tempfile::tempdir().expect("a folder"));
        let data = files.at("data.parquet");
        let play = ["rollout", "--env", "PointMass-v0", "--policy", "random"];
        let run = ksim([&play[..], &["--episodes", "8", "-o", &data]].concat());
        assert_eq!(run.code, 0, "{}", run.stderr);
        let (model_dim, embedding_dim, dim_mult) = (16, 16, vec![1, 2]);
        let embedding = TimestepEmbedding::Integer;
        let unet = Architecture::Janner(JannerConfig {
            horizon: HORIZON,
            width: WIDTH,
            model_dim,
            embedding_dim,
            dim_mult: dim_mult.clone(),
            kernel_size: 5,
            embedding,
        });
        let half = |out_dim, model_dim| {
            Architecture::HalfJanner(HalfJannerConfig {
                horizon: HORIZON,
                width: WIDTH,
                out_dim,
                model_dim,
                embedding_dim,
                dim_mult: dim_mult.clone(),
                kernel_size: 3,
                embedding,
            })
        };
        files.save("diffusion_ckpt_latest.pt", &unet, "diffusion.", true);
        files.save("classifier_ckpt_latest.pt", &half(1, 16), "", true);
        files.save("rnd_classifier_ckpt_latest.pt", &half(64, 16), "", true);
        files.save("rnd_classifier_target.pt", &half(64, 8), "", false);
        files
    }

    fn save(&self, name: &str, architecture: &Architecture, prefix: &str, is_trained: bool) {
        let [weights, average] =
            [1, 2].map(|seed| initial_weights(architecture, seed).expect("weights"));
        let dict = |under, weights| StateDict {
            under,
            prefix,
            weights,
        };
        let bytes = match is_trained {
            true => torch_save(&[dict("model", &weights), dict("model_ema", &average)]),
            false => torch_save(&[dict("", &weights)]),
        };
        fs::write(self.at(name), bytes).expect("it is written");
    }

    fn at(&self, name: &str) -> String {
        let path = self.0.path().join(name);
        path.to_str().expect("a path in UTF-8").to_owned()
    }

    fn import(&self, names: &[&str], flags: &[&str]) -> Run {
        let files: Vec<String> = names.iter().map(|name| self.at(name)).collect();
        let files: Vec<&str> = files.iter().map(String::as_str).collect();
        let (data, run) = (self.at("data.parquet"), self.at("run"));
        let to = ["--dataset", &data, "-o", &run];
        ksim([&["planner", "import"][..], &files[..], &to[..], flags].concat())
    }
}

const DIFFUSER: [&str; 2] = ["diffusion_ckpt_latest.pt", "classifier_ckpt_latest.pt"];
const HOPPER: [&str; 4] = ["--preset", "paper-hopper-medium", "--horizon", "4"];

#[test]
fn imported_files_become_a_run_that_plays() {
    let files = Files::new();
    let curiosity = ["rnd_classifier_target.pt", "rnd_classifier_ckpt_latest.pt"];
    let imported = files.import(&[&curiosity[..], &DIFFUSER].concat(), &HOPPER);
    assert_eq!(imported.code, 0, "{}", imported.stderr);
    let run = files.at("run");
    let next = format!("ksim rollout --planner {run}");
    for part in ["curiosity-diffuser", "reference", &next] {
        assert!(
            imported.stdout.contains(part),
            "{part} in {}",
            imported.stdout
        );
    }
    let info = ksim(["planner", "info", &run, "--format", "json"]).json();
    let manifest = &info["manifest"];
    assert_eq!(info["in_this_build"], true);
    assert_eq!(manifest["config"]["mode"], "reference");
    assert_eq!(manifest["imported"][2]["network"], "diffusion");
    assert_eq!(manifest["imported"][2]["file"], DIFFUSER[0]);
    let hash = blake3::hash(&fs::read(files.at(DIFFUSER[0])).expect("it is there"));
    assert_eq!(manifest["imported"][2]["blake3"], hash.to_hex().as_str());
    let text = ksim(["planner", "info", &run]).stdout;
    assert!(text.contains(DIFFUSER[0]), "{text}");

    let play = ["rollout", "--env", "PointMass-v0", "--planner", &run];
    let flags = ["--episodes", "2", "--candidates", "3", "--format", "json"];
    let played = ksim([&play[..], &flags].concat()).json();
    assert_eq!(played["episodes"].as_array().map(Vec::len), Some(2));

    let train = ["train", "curiosity-diffuser", "--resume", "--dataset"];
    let data = files.at("data.parquet");
    let smoke = ["--preset", "smoke", "-o", &run];
    let resumed = ksim([&train[..], &[data.as_str()], &smoke].concat());
    resumed.failed(1, &["manifest.json", "expected a training to go on with"]);
    files
        .import(&DIFFUSER, &HOPPER)
        .failed(1, &["the folder of another run"]);
}

#[test]
fn imports_that_cannot_be_are_refused_and_leave_nothing() {
    let files = Files::new();
    let evil = b"\x80\x02cposix\nsystem\nX\x04\0\0\0exit\x85R.";
    fs::write(files.at("pickle.pt"), evil).expect("it is written");
    let whole = fs::read(files.at(DIFFUSER[0])).expect("it is there");
    fs::write(files.at("cut.pt"), &whole[..whole.len() / 2]).expect("it is written");
    let entries = [("c/data.pkl", &evil[..]), ("c/version", b"3\n")];
    let entries = entries.map(|(name, contents)| (name.to_owned(), contents.to_vec()));
    fs::write(files.at("evil.pt"), archive(&entries)).expect("it is written");
    // Files, flags, exit code, parts of the message.
    type Case<'a> = (&'a [&'a str], &'a [&'a str], i32, &'a [&'a str]);
    let cases: [Case<'_>; 7] = [
        (&["pickle.pt"], &HOPPER, 1, &["pickle.pt", "a bare pickle"]),
        (&["cut.pt"], &HOPPER, 1, &["cut.pt", "not a whole zip"]),
        (&["evil.pt"], &HOPPER, 1, &["\"posix.system\" is refused"]),
        (&["none.pt"], &HOPPER, 1, &["none.pt", "cannot open"]),
        (&DIFFUSER[..1], &HOPPER, 1, &["the network \"reward\""]),
        (&DIFFUSER, &HOPPER[..2], 1, &["expected 32"]),
        (&DIFFUSER, &HOPPER[2..], 2, &["--preset"]),
    ];
    for (names, flags, code, parts) in cases {
        files.import(names, flags).failed(code, parts);
        assert!(!Path::new(&files.at("run")).exists(), "{names:?}");
    }
}
