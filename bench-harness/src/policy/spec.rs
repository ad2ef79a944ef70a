//! What a user writes to name a policy.

use std::fmt;
use std::path::{Path, PathBuf};

use super::PolicyError;

/// Kinds of policies: how they are written, and what they do.
pub const KINDS: &[(&str, &str)] = &[
    ("random", "uniform in the action space"),
    ("zero", "does nothing"),
    (
        "replay:FILE",
        "the actions of a recorded dataset, episode by episode",
    ),
    (
        "mlp:FILE.safetensors[,sample=true][,noise=STD]",
        "a network; deterministic unless sampled, with Gaussian action noise",
    ),
    (
        "waypoint:FAR.safetensors[,near=NEAR.safetensors][,noise=STD]",
        "drives an ant through a maze with networks that run straight",
    ),
];

/// A policy as it is named on a command line.
///
/// Written `kind`, `kind:FILE` or `kind:FILE,option=value,…`; a bare path that ends in `.safetensors` is an `mlp`.
/// A comma starts an option only if a name in lower case and `=` follow it, so other commas belong to the path.
///
/// ```
/// use ksim_bench_harness::policy::PolicySpec;
///
/// let spec = PolicySpec::parse("mlp:hopper-tqc.safetensors,noise=0.2")?;
/// assert_eq!(spec.to_string(), "mlp:hopper-tqc,noise=0.2");
/// # Ok::<(), ksim_bench_harness::policy::PolicyError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub enum PolicySpec {
    /// [`super::Random`].
    Random,
    /// [`super::Zero`].
    Zero,
    /// [`super::Replay`].
    Replay {
        /// A dataset in any format that is read.
        file: PathBuf,
    },
    /// [`super::Mlp`].
    Mlp {
        /// Safetensors file.
        file: PathBuf,
        /// Whether actions are drawn from the policy's distribution.
        sample: bool,
        /// Standard deviation of the noise added to actions.
        noise: f64,
    },
    /// [`super::Waypoint`].
    Waypoint {
        /// Safetensors file of the network that runs between waypoints.
        far: PathBuf,
        /// Safetensors file of the network that takes over close to the goal; `far` if `None`.
        near: Option<PathBuf>,
        /// Standard deviation of the noise added to actions.
        noise: f64,
    },
}

impl PolicySpec {
    /// Reads a specification; opens no file.
    ///
    /// # Errors
    /// An unknown kind or option, a file that is missing or superfluous, or a value that cannot be used.
    pub fn parse(text: &str) -> Result<Self, PolicyError> {
        let (kind, rest) = split_kind(text)?;
        let (file, mut options) = Options::split(kind, rest);
        let spec = match (kind, file) {
            ("random", None) => Self::Random,
            ("zero", None) => Self::Zero,
            ("replay", Some(file)) => Self::Replay { file: file.into() },
            ("mlp", Some(file)) => Self::Mlp {
                file: file.into(),
                sample: options.take_flag("sample")?,
                noise: options.take_std("noise")?,
            },
            ("waypoint", Some(far)) => Self::Waypoint {
                far: far.into(),
                near: options.take("near").map(PathBuf::from),
                noise: options.take_std("noise")?,
            },
            _ => {
                return Err(PolicyError::Syntax {
                    found: text.to_owned(),
                    expected: syntax(kind),
                });
            }
        };
        options.refuse_rest(spec.options())?;
        Ok(spec)
    }

    /// Files that it is made of.
    pub fn files(&self) -> Vec<PathBuf> {
        match self {
            Self::Random | Self::Zero => Vec::new(),
            Self::Replay { file } | Self::Mlp { file, .. } => vec![file.clone()],
            Self::Waypoint { far, near, .. } => [far].into_iter().chain(near).cloned().collect(),
        }
    }

    fn options(&self) -> &'static [&'static str] {
        match self {
            Self::Random | Self::Zero | Self::Replay { .. } => &[],
            Self::Mlp { .. } => &["sample", "noise"],
            Self::Waypoint { .. } => &["near", "noise"],
        }
    }
}

/// The name of the policy, without folders and what is left at its default.
impl fmt::Display for PolicySpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let noise = match self {
            Self::Random => return f.write_str("random"),
            Self::Zero => return f.write_str("zero"),
            Self::Replay { file } => return write!(f, "replay:{}", stem(file)),
            Self::Mlp {
                file,
                sample,
                noise,
            } => {
                write!(f, "mlp:{}", stem(file))?;
                if *sample {
                    f.write_str(",sample=true")?;
                }
                noise
            }
            Self::Waypoint { far, near, noise } => {
                write!(f, "waypoint:{}", stem(far))?;
                if let Some(near) = near {
                    write!(f, ",near={}", stem(near))?;
                }
                noise
            }
        };
        if *noise > 0.0 {
            write!(f, ",noise={noise}")?;
        }
        Ok(())
    }
}

fn stem(path: &Path) -> std::borrow::Cow<'_, str> {
    path.file_stem()
        .unwrap_or(path.as_os_str())
        .to_string_lossy()
}

/// The kinds as a list.
pub(super) fn known_kinds() -> String {
    let kinds: Vec<&str> = KINDS.iter().map(|(syntax, _)| *syntax).collect();
    kinds.join(", ")
}

fn kind_of(syntax: &'static str) -> &'static str {
    syntax.split(':').next().unwrap_or(syntax)
}

/// How a kind is written.
fn syntax(kind: &str) -> &'static str {
    let mut known = KINDS.iter().map(|(syntax, _)| *syntax);
    known
        .find(|syntax| kind_of(syntax) == kind)
        .unwrap_or_default()
}

/// Kind, and what follows it.
fn split_kind(text: &str) -> Result<(&'static str, &str), PolicyError> {
    let end = text.find([':', ',']).unwrap_or(text.len());
    let mut known = KINDS.iter().map(|(syntax, _)| kind_of(syntax));
    if let Some(kind) = known.find(|kind| *kind == &text[..end]) {
        let rest = &text[end..];
        return Ok((kind, rest.strip_prefix(':').unwrap_or(rest)));
    }
    let (file, _) = Options::split("mlp", text);
    if file.is_some_and(|file| file.ends_with(".safetensors")) {
        return Ok(("mlp", text));
    }
    Err(PolicyError::UnknownKind {
        found: text.to_owned(),
    })
}

/// Options not yet looked at.
struct Options<'a> {
    kind: &'static str,
    rest: Vec<(&'a str, &'a str)>,
}

impl<'a> Options<'a> {
    /// Splits `FILE,option=value,…`.
    fn split(kind: &'static str, text: &'a str) -> (Option<&'a str>, Self) {
        let mut starts: Vec<usize> = text
            .match_indices(',')
            .map(|(at, _)| at)
            .filter(|&at| option_name(&text[at + 1..]).is_some())
            .collect();
        starts.push(text.len());
        let file = &text[..starts[0]];
        let rest = starts
            .windows(2)
            .filter_map(|range| text[range[0] + 1..range[1]].split_once('='))
            .collect();
        ((!file.is_empty()).then_some(file), Self { kind, rest })
    }

    fn take(&mut self, name: &str) -> Option<&'a str> {
        let at = self.rest.iter().position(|(found, _)| *found == name)?;
        Some(self.rest.remove(at).1)
    }

    fn take_flag(&mut self, name: &str) -> Result<bool, PolicyError> {
        match self.take(name) {
            None | Some("false") => Ok(false),
            Some("true") => Ok(true),
            Some(value) => Err(self.refuse(name, value, "true or false")),
        }
    }

    fn take_std(&mut self, name: &str) -> Result<f64, PolicyError> {
        let Some(value) = self.take(name) else {
            return Ok(0.0);
        };
        let std = value.parse().ok();
        std.filter(|std: &f64| std.is_finite() && *std >= 0.0)
            .ok_or_else(|| self.refuse(name, value, "a number of 0 or more"))
    }

    fn refuse(&self, name: &str, value: &str, expected: &str) -> PolicyError {
        PolicyError::Option {
            kind: self.kind,
            option: format!("{name}={value}"),
            expected: expected.to_owned(),
        }
    }

    /// What is left is unknown, or was given twice.
    fn refuse_rest(&self, known: &[&str]) -> Result<(), PolicyError> {
        match self.rest.first() {
            None => Ok(()),
            Some((name, value)) if known.contains(name) => Err(self.refuse(name, value, "it once")),
            Some((name, value)) if known.is_empty() => Err(self.refuse(name, value, "no options")),
            Some((name, value)) => {
                Err(self.refuse(name, value, &format!("one of {}", known.join(", "))))
            }
        }
    }
}

/// The name before `=`, if `text` starts with an option.
fn option_name(text: &str) -> Option<&str> {
    let (name, _) = text.split_once('=')?;
    let is_name = !name.is_empty()
        && name
            .bytes()
            .all(|byte| byte.is_ascii_lowercase() || byte == b'_');
    is_name.then_some(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn specifications_are_read_and_named() {
        let cases = [
            ("random", "random"),
            ("zero", "zero"),
            ("replay:a/b.parquet", "replay:b"),
            ("mlp:a.safetensors", "mlp:a"),
            ("a/b.safetensors", "mlp:b"),
            ("b.safetensors,sample=true", "mlp:b,sample=true"),
            (
                "mlp:x/a,b.safetensors,noise=0.2,sample=true",
                "mlp:a,b,sample=true,noise=0.2",
            ),
            (
                "waypoint:f.safetensors,near=d/n,1.safetensors,noise=1",
                "waypoint:f,near=n,1,noise=1",
            ),
        ];
        for (text, name) in cases {
            assert_eq!(PolicySpec::parse(text).unwrap().to_string(), name);
        }
        assert_eq!(
            PolicySpec::parse(r"C:\a.safetensors").unwrap(),
            PolicySpec::Mlp {
                file: r"C:\a.safetensors".into(),
                sample: false,
                noise: 0.0
            }
        );
    }

    #[test]
    fn errors_say_what_there_is() {
        let cases = [
            (
                "greedy",
                "unknown policy `greedy`, expected one of: random, zero, replay:FILE",
            ),
            ("", "unknown policy ``"),
            ("random:x", "expected random"),
            ("mlp", "expected mlp:FILE.safetensors"),
            ("mlp:", "expected mlp:FILE.safetensors"),
            (
                "random,noise=1",
                "`random`: option `noise=1`: expected no options",
            ),
            (
                "mlp:a,temperature=2",
                "option `temperature=2`: expected one of sample, noise",
            ),
            (
                "mlp:a,noise=-1",
                "option `noise=-1`: expected a number of 0 or more",
            ),
            ("mlp:a,noise=NaN", "a number of 0 or more"),
            (
                "mlp:a,noise=1,noise=2",
                "option `noise=2`: expected it once",
            ),
            ("mlp:a,sample=yes", "expected true or false"),
        ];
        for (text, message) in cases {
            let found = PolicySpec::parse(text).unwrap_err().to_string();
            assert!(found.contains(message), "{text}: {found}");
        }
    }
}
