//! The robots as MJCF, MuJoCo's model format, written from their published numbers.
//!
//! A compiled model decides a trajectory, not the file it came from, so these are our own files: tables of lengths,
//! masses and limits, and the text made of them. The tests compare every compiled number that is known of the
//! published models. A number that looks odd, such as `1.05 - 1.25`, is written as the difference of heights that
//! gives its last bit.
//!
//! Camera and light change nothing that moves; the published models have one of each, and so have ours.

pub(crate) mod ant;
mod half_cheetah;
mod legged;
pub(crate) mod maze;

/// The model that goes by the name of a published file.
pub(crate) fn published(file: &str) -> Option<String> {
    Some(match file {
        "ant.xml" => ant::xml(""),
        "half_cheetah.xml" => half_cheetah::xml(),
        "hopper.xml" => legged::hopper(),
        "walker2d.xml" => legged::walker2d(0.9),
        "walker2d_v5.xml" => legged::walker2d(1.9),
        _ => return None,
    })
}

/// Numbers as an attribute's value: each as short as it can be read back exactly.
fn numbers<const N: usize>(values: [f64; N]) -> String {
    values.map(|value| value.to_string()).join(" ")
}

/// A motor on a hinge: torque [Nm] is `gear` times the control, which is in [-1, 1].
fn motor(name: Option<&str>, joint: &str, gear: f64) -> String {
    let name = name.map_or(String::new(), |name| format!(r#" name="{name}""#));
    format!(r#"<motor{name} joint="{joint}" gear="{gear}" ctrllimited="true" ctrlrange="-1 1"/>"#)
}

/// The ground with the light above it.
fn ground(size: [f64; 3], more: &str) -> String {
    format!(
        r#"<light directional="true" pos="0 0 1.3" dir="0 0 -1.3"/>
        <geom name="floor" type="plane" size="{}" conaffinity="1" rgba="0.8 0.9 0.8 1" {more}/>"#,
        numbers(size)
    )
}

/// The camera that follows the robot, in its first body.
const CAMERA: &str =
    r#"<camera name="track" mode="trackcom" pos="0 -3 0.3" xyaxes="1 0 0 0 0 1"/>"#;
