//! The build script of the packages whose binaries and tests load libmujoco or libtorch: they look for them where
//! they were linked from, so that no `LD_LIBRARY_PATH` is needed. A moved checkout links anew.

use std::path::Path;

/// Feature that needs a library, variable that says where it lies, and the folder below.
const LIBRARIES: [(&str, &str, &str); 2] = [
    ("CARGO_FEATURE_MUJOCO", "MUJOCO_DYNAMIC_LINK_DIR", ""),
    ("CARGO_FEATURE_TORCH", "LIBTORCH", "lib"),
];

#[expect(clippy::print_stdout, reason = "how a build script speaks to Cargo")]
fn main() {
    for (feature, place, below) in LIBRARIES {
        println!("cargo::rerun-if-env-changed={place}");
        let place = std::env::var_os(feature).and(std::env::var_os(place));
        if let Some(place) = place {
            let folder = Path::new(&place).join(below);
            println!("cargo::rustc-link-arg=-Wl,-rpath,{}", folder.display());
        }
    }
}
