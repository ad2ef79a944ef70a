//! Ant: a ball on four legs of three capsules each, 0.91 kg.

use super::{CAMERA, ground, motor};

/// A leg, in the order of bodies and joints.
struct Leg {
    /// Where it points: the signs of x and y.
    x: f64,
    y: f64,
    /// Name of the body that is fixed to the torso.
    body: &'static str,
    /// Names of the two capsules that move.
    geoms: [&'static str; 2],
}

const LEGS: [Leg; 4] = [
    Leg {
        x: 1.0,
        y: 1.0,
        body: "front_left_leg",
        geoms: ["left_leg_geom", "left_ankle_geom"],
    },
    Leg {
        x: -1.0,
        y: 1.0,
        body: "front_right_leg",
        geoms: ["right_leg_geom", "right_ankle_geom"],
    },
    Leg {
        x: -1.0,
        y: -1.0,
        body: "back_leg",
        geoms: ["back_leg_geom", "third_ankle_geom"],
    },
    Leg {
        x: 1.0,
        y: -1.0,
        body: "right_back_leg",
        geoms: ["rightback_leg_geom", "fourth_ankle_geom"],
    },
];

/// The legs by number, in the order of the actuators: not the order of the joints.
const ACTUATED: [usize; 4] = [4, 1, 2, 3];

/// Reach of hip and upper leg along x and y, and of the lower leg, in m.
const UPPER: f64 = 0.2;
const LOWER: f64 = 0.4;

impl Leg {
    /// `number` is from 1, as in the joints' names.
    fn xml(&self, number: usize) -> String {
        let Self { x, y, body, geoms } = self;
        let [upper_geom, lower_geom] = geoms;
        let upper = format!("{} {} 0", UPPER * x, UPPER * y);
        let lower = format!("{} {} 0", LOWER * x, LOWER * y);
        // The ankle turns about the horizontal across the leg; legs 1 and 4 bend with positive angles.
        let axis = format!("{} 1 0", -x * y);
        let range = if *x > 0.0 { "30 70" } else { "-70 -30" };
        format!(
            r#"
            <body name="{body}">
                <geom name="aux_{number}_geom" type="capsule" size="0.08" fromto="0 0 0 {upper}"/>
                <body name="aux_{number}" pos="{upper}">
                    <joint name="hip_{number}" type="hinge" axis="0 0 1" range="-30 30"/>
                    <geom name="{upper_geom}" type="capsule" size="0.08" fromto="0 0 0 {upper}"/>
                    <body pos="{upper}">
                        <joint name="ankle_{number}" type="hinge" axis="{axis}" range="{range}"/>
                        <geom name="{lower_geom}" type="capsule" size="0.08" fromto="0 0 0 {lower}"/>
                    </body>
                </body>
            </body>"#
        )
    }
}

/// The model, with more elements in its world: a maze's walls and target.
pub(crate) fn xml(world: &str) -> String {
    let legs: String = (1..)
        .zip(&LEGS)
        .map(|(number, leg)| leg.xml(number))
        .collect();
    let motors: String = ACTUATED
        .iter()
        .flat_map(|leg| [format!("hip_{leg}"), format!("ankle_{leg}")])
        .map(|joint| motor(None, &joint, 150.0))
        .collect();
    let ground = ground([40.0; 3], "");
    format!(
        r#"<mujoco model="ant">
    <compiler angle="degree"/>
    <option timestep="0.01" integrator="RK4"/>
    <default>
        <joint armature="1" damping="1" limited="true"/>
        <geom contype="1" conaffinity="0" condim="3" friction="1 0.5 0.5" margin="0.01" density="5"
            rgba="0.8 0.6 0.4 1"/>
    </default>
    <worldbody>
        {ground}
        <body name="torso" pos="0 0 0.75">
            {CAMERA}
            <joint name="root" type="free" armature="0" damping="0" limited="false" margin="0.01"/>
            <geom name="torso_geom" type="sphere" size="0.25"/>{legs}
        </body>
        {world}
    </worldbody>
    <actuator>{motors}</actuator>
</mujoco>
"#
    )
}
