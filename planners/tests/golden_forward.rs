//! Networks against outputs and gradients of the reference implementation (PyTorch), for every `forward_*` file.

#![cfg(feature = "native")]
#![allow(clippy::unwrap_used, reason = "a test that gets no network fails")]

mod support;

use ksim_planners::nets::{Backend, Network, TimestepEmbedding};
use support::tolerance::assert_close;
use support::{File, Folder, backends, folders};

/// Of outputs, relative to the largest.
const FORWARD: f64 = 1e-5;
/// Of gradients by the input.
const GRADIENT: f64 = 2e-5;
/// Of the guidance's value.
const LOGP: f64 = 5e-5;
/// The cases with λ = 10⁶ may be this much looser.
const LARGE_LAMBDA: f64 = 3.0;

const NETS: [&str; 4] = ["unet", "reward", "rnd_pred", "rnd_target"];

/// Calls `test` with every backend, folder and file.
fn for_every_file(test: impl Fn(&dyn Backend, &Folder, &File)) {
    let mut n_files = 0;
    for backend in backends() {
        for folder in folders() {
            for file in folder.files("forward_") {
                test(backend.as_ref(), &folder, &file);
                n_files += 1;
            }
        }
    }
    assert!(n_files > 0, "no forward_* file was found");
}

struct Case<'a> {
    backend: &'a dyn Backend,
    folder: &'a Folder,
    file: &'a File,
}

impl Case<'_> {
    fn network(&self, net: &str, embedding: TimestepEmbedding) -> Box<dyn Network> {
        let architecture = self.file.architecture(net, embedding);
        let weights = self.folder.weights(self.file, net);
        self.backend.network(&architecture, &weights).unwrap()
    }

    fn what(&self, of: &str) -> String {
        format!("{} {} {of}", self.backend.name(), self.file.name)
    }

    /// Outputs and, with the cotangent that `cotangent` makes of them, gradients by x, of `together` windows at once.
    fn gradient(&self, net: &str, cotangent: impl Fn(&[f32]) -> Vec<f32>) -> (Vec<f32>, Vec<f32>) {
        let mut network = self.network(net, TimestepEmbedding::Integer);
        let (x, t) = (self.file.values("x"), self.file.values("t_long"));
        let mut out = vec![f32::NAN; t.len() * network.architecture().output_len()];
        network.forward(x, t, true, &mut out).unwrap();
        let mut gradient = vec![f32::NAN; x.len()];
        let cotangent = cotangent(&out);
        network.input_gradient(&cotangent, &mut gradient).unwrap();
        (out, gradient)
    }

    /// Gradients of the sum of the outputs, one window at a time.
    fn gradients_alone(&self, net: &str) -> Vec<f32> {
        let mut network = self.network(net, TimestepEmbedding::Integer);
        let (x, t) = (self.file.values("x"), self.file.values("t_long"));
        let mut gradient = vec![f32::NAN; x.len()];
        let mut out = vec![f32::NAN; network.architecture().output_len()];
        let len = x.len() / t.len();
        let windows = x.chunks(len).zip(gradient.chunks_mut(len));
        for (t, (x, gradient)) in t.iter().zip(windows) {
            network.forward(x, &[*t], true, &mut out).unwrap();
            let ones = vec![1.0; out.len()];
            network.input_gradient(&ones, gradient).unwrap();
        }
        gradient
    }
}

#[test]
fn golden_forward_outputs() {
    for_every_file(|backend, folder, file| {
        let case = Case {
            backend,
            folder,
            file,
        };
        for net in NETS {
            for (embedding, t, out) in [
                (TimestepEmbedding::Integer, "t_long", "out_long"),
                (TimestepEmbedding::Sinusoidal, "t_float", "out_float"),
            ] {
                let mut network = case.network(net, embedding);
                let t = file.values(t);
                let expected = file.values(&format!("{net}_{out}"));
                let x = file.values("x");
                // A backend may compute a single window otherwise than many.
                for together in [t.len(), 1] {
                    let mut found = vec![f32::NAN; expected.len()];
                    let windows = x.chunks(x.len() / t.len() * together);
                    let outputs = found.chunks_mut(expected.len() / t.len() * together);
                    for ((x, t), out) in windows.zip(t.chunks(together)).zip(outputs) {
                        network.forward(x, t, false, out).unwrap();
                    }
                    let what = case.what(&format!("{net} {out}, {together} at once"));
                    assert_close(&found, expected, FORWARD, &what);
                }
            }
        }
    });
}

#[test]
fn golden_forward_input_gradients() {
    for_every_file(|backend, folder, file| {
        let case = Case {
            backend,
            folder,
            file,
        };
        for net in ["reward", "rnd_pred", "rnd_target"] {
            let (_, gradient) = case.gradient(net, |out| vec![1.0; out.len()]);
            let expected = file.values(&format!("{net}_grad_x_of_sum"));
            let alone = case.gradients_alone(net);
            let what = case.what(&format!("{net} gradient of single windows"));
            assert_close(&alone, expected, GRADIENT, &what);
            assert_close(
                &gradient,
                expected,
                GRADIENT,
                &case.what(&format!("{net} gradient")),
            );
        }
    });
}

/// logp = R − λ·Σ(predictor − target)² and its gradient by x.
#[test]
fn golden_forward_guidance() {
    for_every_file(|backend, folder, file| {
        let case = Case {
            backend,
            folder,
            file,
        };
        let (reward, by_reward) = case.gradient("reward", |out| vec![1.0; out.len()]);
        let (target, _) = case.gradient("rnd_target", |out| vec![0.0; out.len()]);
        let difference = |sign: f32, of: &[f32], from: &[f32]| -> Vec<f32> {
            let pairs = of.iter().zip(from);
            pairs.map(|(a, b)| sign * 2.0 * (a - b)).collect()
        };
        let (predicted, by_predictor) =
            case.gradient("rnd_pred", |out| difference(1.0, out, &target));
        let (_, by_target) = case.gradient("rnd_target", |out| difference(-1.0, &predicted, out));
        let width = target.len() / reward.len();
        let rows = predicted.chunks(width).zip(target.chunks(width));
        let novelty: Vec<f32> = rows
            .map(|(p, q)| p.iter().zip(q).map(|(p, q)| (p - q) * (p - q)).sum())
            .collect();
        assert_close(
            &novelty,
            file.values("rnd_novelty"),
            LOGP,
            &case.what("novelty"),
        );
        for (lambda, name, slack) in [(10.0, "10", 1.0), (1e6, "1e+06", LARGE_LAMBDA)] {
            let logp: Vec<f32> = reward
                .iter()
                .zip(&novelty)
                .map(|(r, n)| r - lambda * n)
                .collect();
            let expected = file.values(&format!("rnd_logp_lambda{name}"));
            assert_close(
                &logp,
                expected,
                slack * LOGP,
                &case.what(&format!("logp, λ {name}")),
            );
            let by_novelty = by_predictor.iter().zip(&by_target).map(|(p, q)| p + q);
            let total: Vec<f32> = by_reward
                .iter()
                .zip(by_novelty)
                .map(|(r, n)| r - lambda * n)
                .collect();
            let expected = file.values(&format!("rnd_grad_lambda{name}"));
            let what = case.what(&format!("gradient of logp, λ {name}"));
            assert_close(&total, expected, slack * GRADIENT, &what);
        }
    });
}
