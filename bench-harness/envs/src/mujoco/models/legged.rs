//! Hopper and Walker2d: a planar torso of 1.25 m on one leg or on two, and what sets the two apart.

use super::{CAMERA, ground, motor};

/// Heights in the upright pose, in m.
const TOP: f64 = 1.45;
const ORIGIN: f64 = 1.25;
const HIP: f64 = 1.05;
const KNEE: f64 = 0.6;
const LEG: f64 = 0.35;
const ANKLE: f64 = 0.1;

/// A leg: thigh, leg and foot, with a hinge above each.
struct Leg {
    /// Ends the names: `_left` for Walker2d's second.
    suffix: &'static str,
    /// How far the foot's body stands before the ankle, and its two ends from there, in m.
    foot_x: f64,
    foot_ends: [f64; 2],
    foot_friction: f64,
    color: &'static str,
}

impl Leg {
    fn xml(&self) -> String {
        let Self {
            suffix,
            foot_x,
            foot_ends: [from, to],
            foot_friction,
            color,
        } = self;
        let rgba = format!(r#"rgba="{color}""#);
        let hinge = |name: &str, place: &str| {
            format!(r#"<joint name="{name}{suffix}_joint" type="hinge" axis="0 -1 0" {place}/>"#)
        };
        let bend = r#"range="-150 0""#;
        format!(
            r#"
            <body name="thigh{suffix}" pos="0 0 {thigh_z}">
                {thigh_joint}
                <geom name="thigh{suffix}_geom" type="capsule" size="0.05 {thigh_half}" pos="0 0 {thigh_center}" {rgba}/>
                <body name="leg{suffix}" pos="0 0 {leg_z}">
                    {leg_joint}
                    <geom name="leg{suffix}_geom" type="capsule" size="0.04 0.25" {rgba}/>
                    <body name="foot{suffix}" pos="{foot_x} 0 -0.35">
                        {foot_joint}
                        <geom name="foot{suffix}_geom" type="capsule" size="0.06" fromto="{from} 0 {ANKLE} {to} 0 {ANKLE}"
                            friction="{foot_friction}" {rgba}/>
                    </body>
                </body>
            </body>"#,
            thigh_z = HIP - ORIGIN,
            thigh_half = (HIP - KNEE) / 2.0,
            thigh_center = (HIP + KNEE) / 2.0 - HIP,
            leg_z = LEG - HIP,
            thigh_joint = hinge("thigh", bend),
            leg_joint = hinge("leg", &format!(r#"pos="0 0 {}" {bend}"#, KNEE - LEG)),
            foot_joint = hinge(
                "foot",
                &format!(r#"pos="{} 0 {ANKLE}" range="-45 45""#, -foot_x)
            ),
        )
    }

    fn motors(&self, gear: f64) -> String {
        ["thigh", "leg", "foot"]
            .map(|part| motor(None, &format!("{part}{}_joint", self.suffix), gear))
            .concat()
    }
}

/// What a robot of this kind has beside its legs.
struct Robot<'a> {
    name: &'a str,
    legs: &'a [Leg],
    gear: f64,
    /// Armature and damping of the leg's hinges.
    armature: f64,
    damping: f64,
    /// Attributes of all capsules.
    geom: &'a str,
    ground: String,
}

impl Robot<'_> {
    fn xml(&self) -> String {
        let Self {
            name,
            gear,
            armature,
            damping,
            geom,
            ground,
            ..
        } = self;
        let legs: String = self.legs.iter().map(Leg::xml).collect();
        let motors: String = self.legs.iter().map(|leg| leg.motors(*gear)).collect();
        let root = r#"armature="0" damping="0" limited="false""#;
        let half = (TOP - HIP) / 2.0;
        format!(
            r#"<mujoco model="{name}">
    <compiler angle="degree"/>
    <option timestep="0.002" integrator="RK4"/>
    <default>
        <joint armature="{armature}" damping="{damping}" limited="true"/>
        <geom contype="1" rgba="0.8 0.6 0.4 1" {geom}/>
    </default>
    <worldbody>
        {ground}
        <body name="torso" pos="0 0 {ORIGIN}">
            {CAMERA}
            <joint name="rootx" type="slide" axis="1 0 0" pos="0 0 -{ORIGIN}" {root}/>
            <joint name="rootz" type="slide" axis="0 0 1" pos="0 0 -{ORIGIN}" ref="{ORIGIN}" {root}/>
            <joint name="rooty" type="hinge" axis="0 1 0" {root}/>
            <geom name="torso_geom" type="capsule" size="0.05 {half}" friction="0.9"/>{legs}
        </body>
    </worldbody>
    <actuator>{motors}</actuator>
</mujoco>
"#
        )
    }
}

const BROWN: &str = "0.8 0.6 0.4 1";
const PURPLE: &str = "0.7 0.3 0.6 1";

/// Hopper, 15.8 kg.
pub(crate) fn hopper() -> String {
    Robot {
        name: "hopper",
        legs: &[Leg {
            suffix: "",
            foot_x: 0.13,
            foot_ends: [-0.26, 0.13],
            foot_friction: 2.0,
            color: BROWN,
        }],
        gear: 200.0,
        armature: 1.0,
        damping: 1.0,
        geom: r#"conaffinity="1" condim="1" friction="0.9" margin="0.001" solimp="0.8 0.8 0.01""#,
        ground: ground([20.0, 20.0, 0.125], r#"condim="3" friction="1""#),
    }
    .xml()
}

/// Walker2d, 23.7 kg. The sliding friction of the right foot is 0.9 in version 4 and 1.9, as the left one's, in
/// version 5.
pub(crate) fn walker2d(right_foot_friction: f64) -> String {
    let leg = |suffix, foot_friction, color| Leg {
        suffix,
        foot_x: 0.2,
        foot_ends: [-0.2, 0.0],
        foot_friction,
        color,
    };
    Robot {
        name: "walker2d",
        legs: &[
            leg("", right_foot_friction, BROWN),
            leg("_left", 1.9, PURPLE),
        ],
        gear: 100.0,
        armature: 0.01,
        damping: 0.1,
        geom: r#"conaffinity="0" condim="3" friction="0.9 0.1 0.1""#,
        ground: ground([40.0; 3], r#"friction="0.7""#),
    }
    .xml()
}
