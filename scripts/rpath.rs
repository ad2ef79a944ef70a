//! The build script of the packages whose binaries and tests load libmujoco: they look for it where
//! it was linked from, so that no `LD_LIBRARY_PATH` is needed. A moved checkout links anew.

#[expect(clippy::print_stdout, reason = "how a build script speaks to Cargo")]
fn main() {
    const PLACE: &str = "MUJOCO_DYNAMIC_LINK_DIR";
    println!("cargo::rerun-if-env-changed={PLACE}");
    if std::env::var_os("CARGO_FEATURE_MUJOCO").is_none() {
        return;
    }
    if let Ok(place) = std::env::var(PLACE) {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{place}");
    }
}
