//! Who may depend on whom (ARCHITECTURE.md), over `cargo metadata` with every feature on.

use std::collections::{BTreeMap, BTreeSet};

use ksim_tests::metadata;
use serde_json::Value;

/// What one package may and may not reach through its normal dependencies.
struct Rule {
    package: &'static str,
    /// Workspace packages it may depend on.
    may: &'static [&'static str],
    /// Crates that may occur nowhere below it; `hdf5*` means every name that begins so.
    never: &'static [&'static str],
    is_library: bool,
}

const RULES: [Rule; 8] = [
    Rule {
        package: "ksim",
        may: &[],
        never: &[
            "tch",
            "torch-sys",
            "mujoco*",
            "hdf5*",
            "arrow*",
            "parquet*",
            "clap*",
            "anyhow",
        ],
        is_library: true,
    },
    Rule {
        package: "ksim-datasets",
        may: &[],
        never: &["tch", "torch-sys", "mujoco*", "clap*", "anyhow"],
        is_library: true,
    },
    Rule {
        package: "ksim-index",
        may: &["ksim"],
        never: &[
            "tch",
            "torch-sys",
            "mujoco*",
            "hdf5*",
            "arrow*",
            "parquet*",
            "clap*",
            "anyhow",
        ],
        is_library: true,
    },
    Rule {
        package: "ksim-planners",
        may: &["ksim", "ksim-datasets"],
        never: &["mujoco*", "clap*", "anyhow"],
        is_library: true,
    },
    Rule {
        package: "ksim-envs",
        may: &["ksim-datasets"],
        never: &["tch", "torch-sys", "clap*", "anyhow"],
        is_library: true,
    },
    Rule {
        package: "ksim-bench-harness",
        may: &["ksim", "ksim-datasets", "ksim-envs", "ksim-planners"],
        never: &["clap*", "anyhow"],
        is_library: true,
    },
    Rule {
        package: "ksim-cli",
        may: &[
            "ksim",
            "ksim-bench-harness",
            "ksim-datasets",
            "ksim-envs",
            "ksim-index",
            "ksim-planners",
        ],
        never: &[],
        is_library: false,
    },
    Rule {
        package: "ksim-tests",
        may: &[],
        never: &[],
        is_library: false,
    },
];

/// A `links` key in the engine's tree that stands for no native library: rayon-core uses it to be
/// linked once.
const LINKS_NOTHING: [&str; 1] = ["rayon-core"];

/// The workspace as cargo resolved it.
struct Graph {
    /// Package by id.
    packages: BTreeMap<String, Value>,
    /// Ids of normal dependencies by id.
    normal: BTreeMap<String, Vec<String>>,
    members: Vec<String>,
}

impl Graph {
    fn load() -> Self {
        let metadata = metadata();
        let packages = list(&metadata["packages"])
            .iter()
            .map(|package| (text(&package["id"]), package.clone()))
            .collect();
        let normal = list(&metadata["resolve"]["nodes"])
            .iter()
            .map(|node| {
                let dependencies = list(&node["deps"]).iter().filter(|dependency| {
                    list(&dependency["dep_kinds"])
                        .iter()
                        .any(|kind| kind["kind"].is_null())
                });
                let ids = dependencies.map(|dependency| text(&dependency["pkg"]));
                (text(&node["id"]), ids.collect())
            })
            .collect();
        let members = list(&metadata["workspace_members"]).iter().map(text);
        Self {
            packages,
            normal,
            members: members.collect(),
        }
    }

    fn name(&self, id: &str) -> &str {
        self.packages[id]["name"].as_str().expect("a name")
    }

    /// Whether a crate runs in the compiler: what it depends on is built into nothing.
    fn is_proc_macro(&self, id: &str) -> bool {
        let is_macro = |target: &Value| list(&target["kind"]).iter().any(|k| k == "proc-macro");
        list(&self.packages[id]["targets"]).iter().any(is_macro)
    }

    /// Everything that is built into a package, itself left out.
    fn below<'a>(&'a self, id: &'a str) -> BTreeSet<&'a str> {
        let mut seen = BTreeSet::new();
        let mut open: Vec<&str> = vec![id];
        while let Some(id) = open.pop() {
            let new = self.normal[id].iter().map(String::as_str);
            let new = new.filter(|&id| seen.insert(id));
            open.extend(new.filter(|&id| !self.is_proc_macro(id)));
        }
        seen
    }

    /// Whether a crate stands for a native library.
    fn links(&self, id: &str) -> bool {
        let links = self.packages[id]["links"].as_str();
        links.is_some_and(|links| !LINKS_NOTHING.contains(&links))
    }

    fn members(&self) -> impl Iterator<Item = (&str, &'static Rule)> {
        self.members.iter().map(|id| {
            let name = self.name(id);
            let rule = RULES.iter().find(|rule| rule.package == name);
            let rule = rule.unwrap_or_else(|| panic!("package {name} has no rule in layering.rs"));
            (id.as_str(), rule)
        })
    }
}

fn list(value: &Value) -> &[Value] {
    value.as_array().expect("a list")
}

fn text(value: &Value) -> String {
    value.as_str().expect("a text").to_owned()
}

fn matches(pattern: &str, name: &str) -> bool {
    match pattern.strip_suffix('*') {
        Some(start) => name.starts_with(start),
        None => name == pattern,
    }
}

#[test]
fn packages_depend_downwards_only() {
    let graph = Graph::load();
    for (id, rule) in graph.members() {
        for below in graph.below(id) {
            let name = graph.name(below);
            let is_member = graph.members.iter().any(|member| member == below);
            assert!(
                !is_member || rule.may.contains(&name),
                "{} must not depend on {name}",
                rule.package
            );
            assert!(
                !rule.never.iter().any(|never| matches(never, name)),
                "{} must not reach {name}",
                rule.package
            );
        }
    }
}

#[test]
fn the_engine_links_no_native_library() {
    let graph = Graph::load();
    let (engine, _) = graph
        .members()
        .find(|(_, rule)| rule.package == "ksim")
        .expect("the engine");
    for id in graph.below(engine) {
        assert!(!graph.links(id), "{} links a library", graph.name(id));
    }
}

/// A feature that links nothing may be on.
#[test]
fn libraries_link_nothing_by_default() {
    let graph = Graph::load();
    for (id, rule) in graph.members().filter(|(_, rule)| rule.is_library) {
        let features = &graph.packages[id]["features"];
        let parts = |name: &str| list(&features[name]).iter().map(text).collect::<Vec<_>>();
        let default = features["default"].is_array().then(|| parts("default"));
        for part in default.iter().flatten().flat_map(|feature| parts(feature)) {
            let turned_on = part.strip_prefix("dep:").expect("a dependency");
            let dependencies = graph.normal[id].iter().map(String::as_str);
            for dependency in dependencies.filter(|id| graph.name(id) == turned_on) {
                let below = graph.below(dependency);
                let native = below.iter().chain([&dependency]).find(|id| graph.links(id));
                assert_eq!(native, None, "{} turns on {part}", rule.package);
            }
        }
    }
}

#[test]
fn libtorch_comes_in_by_one_feature_only() {
    let graph = Graph::load();
    let mut by = Vec::new();
    for (id, rule) in graph.members() {
        let dependencies = list(&graph.packages[id]["dependencies"]);
        let torch = |name: &str| name == "tch" || name == "torch-sys";
        for dependency in dependencies.iter().filter(|d| torch(&text(&d["name"]))) {
            assert_eq!(dependency["optional"], true, "{}", rule.package);
            let features = graph.packages[id]["features"].as_object();
            let turns_on = |(_, parts): &(&String, &Value)| {
                let parts = list(parts).iter().map(text);
                parts.into_iter().any(|part| part.contains("tch"))
            };
            let names = features.expect("features").iter().filter(turns_on);
            by.extend(names.map(|(name, _)| (rule.package, name.as_str())));
        }
    }
    assert_eq!(by, [("ksim-planners", "torch")]);
}

#[test]
fn manifests_take_lints_and_versions_from_the_workspace() {
    let graph = Graph::load();
    for (id, rule) in graph.members() {
        let path = text(&graph.packages[id]["manifest_path"]);
        let manifest = std::fs::read_to_string(&path).expect("a manifest");
        assert!(
            manifest.contains("[lints]\nworkspace = true"),
            "{} has lints of its own",
            rule.package
        );
        for dependency in list(&graph.packages[id]["dependencies"]) {
            let name = text(&dependency["name"]);
            let is_inherited = manifest.lines().any(|line| {
                line.split(['.', ' ', '=']).next() == Some(name.as_str())
                    && line.contains("workspace = true")
            });
            // A dev-dependency on oneself, for a feature, names a path and no version.
            assert!(
                is_inherited || name == rule.package,
                "{} does not take {name} from the workspace",
                rule.package
            );
        }
    }
}
