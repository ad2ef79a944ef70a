//! The ant's world turned, and its legs renamed.

use std::f64::consts::FRAC_PI_2;

/// Numbers of an ant's observation: height, quaternion (w, x, y, z), eight joint angles, linear velocity in the world,
/// angular velocity in the body, eight joint velocities.
pub(super) const ANT_DIM: usize = 27;
/// Hip and ankle of each leg.
pub(super) const ACTION_DIM: usize = 8;

/// Which leg each pair of actions moves; joints come in the order of the legs, 45° and then every 90°.
const ACTUATED: [usize; 4] = [3, 0, 1, 2];
/// Which way the ankle of each leg bends down.
const ANKLE: [f64; 4] = [1.0, -1.0, -1.0, 1.0];

/// How upright an ant is: the cosine of its tilt.
pub(super) fn up(ant: &[f64]) -> f64 {
    let (x, y) = (ant[2], ant[3]);
    1.0 - 2.0 * (x * x + y * y)
}

/// Where an ant faces, in rad from +x.
pub(super) fn yaw(ant: &[f64]) -> f64 {
    let [w, x, y, z] = [ant[1], ant[2], ant[3], ant[4]];
    (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z))
}

/// What an ant is shown so that it runs where it should.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
    /// The direction that it sees as +x, in rad.
    pub(super) heading: f64,
    /// By how many quarter turns to the left its front is moved.
    pub(super) quarters: usize,
}

impl View {
    /// What the ant sees of an observation; both have [`ANT_DIM`] numbers.
    pub(super) fn observation(&self, ant: &[f64]) -> [f64; ANT_DIM] {
        let turned = self.quarters as f64 * FRAC_PI_2;
        let body = product([ant[1], ant[2], ant[3], ant[4]], about_z(turned));
        let mut quaternion = product(about_z(-self.heading), body);
        // Both signs are the same rotation; networks know the one that is near no rotation.
        if quaternion[0] < 0.0 {
            quaternion = quaternion.map(|value| -value);
        }
        let mut seen = [0.0; ANT_DIM];
        seen[0] = ant[0];
        seen[1..5].copy_from_slice(&quaternion);
        self.joints(&ant[5..13], &mut seen[5..13]);
        seen[13..16].copy_from_slice(&turn([ant[13], ant[14], ant[15]], -self.heading));
        seen[16..19].copy_from_slice(&turn([ant[16], ant[17], ant[18]], -turned));
        self.joints(&ant[19..27], &mut seen[19..27]);
        seen
    }

    /// What the ant does when it means to do `seen`.
    pub(super) fn action(&self, seen: &[f64; ACTION_DIM]) -> [f64; ACTION_DIM] {
        let mut action = [0.0; ACTION_DIM];
        for (pair, leg) in seen.chunks_exact(2).zip(ACTUATED) {
            let own = self.own(leg);
            let place = 2 * ((own + 1) % 4);
            action[place] = pair[0];
            action[place + 1] = pair[1] * ANKLE[leg] * ANKLE[own];
        }
        action
    }

    /// The leg that is called `leg`.
    fn own(&self, leg: usize) -> usize {
        (leg + self.quarters) % 4
    }

    fn joints(&self, own: &[f64], seen: &mut [f64]) {
        for (leg, pair) in seen.chunks_exact_mut(2).enumerate() {
            let from = self.own(leg);
            pair[0] = own[2 * from];
            pair[1] = own[2 * from + 1] * ANKLE[leg] * ANKLE[from];
        }
    }
}

/// A rotation about z, as a quaternion (w, x, y, z).
fn about_z(angle: f64) -> [f64; 4] {
    [(angle / 2.0).cos(), 0.0, 0.0, (angle / 2.0).sin()]
}

/// Hamilton's product: the rotation `b`, then `a`.
fn product(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    let [aw, ax, ay, az] = a;
    let [bw, bx, by, bz] = b;
    [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
}

/// A vector turned about z.
fn turn([x, y, z]: [f64; 3], angle: f64) -> [f64; 3] {
    let (sin, cos) = angle.sin_cos();
    [cos * x - sin * y, sin * x + cos * y, z]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An ant in some posture, its quaternion of length 1 with w > 0.
    fn ant() -> [f64; ANT_DIM] {
        let mut ant = [0.0; ANT_DIM];
        for (place, value) in ant.iter_mut().enumerate() {
            *value = (place as f64 * 1.7).sin();
        }
        ant[1..5].copy_from_slice(&[0.8, 0.2, -0.4, 0.4]);
        ant
    }

    fn assert_close(a: &[f64], b: &[f64]) {
        for (place, (a, b)) in a.iter().zip(b).enumerate() {
            assert!((a - b).abs() < 1e-12, "{place}: {a} {b}");
        }
    }

    #[test]
    fn an_ant_that_faces_its_heading_sees_itself_face_x() {
        for quarters in 0..4 {
            let facing = 0.3;
            let mut ant = ant();
            ant[1..5].copy_from_slice(&about_z(facing));
            let heading = facing + quarters as f64 * FRAC_PI_2;
            // Running along its heading.
            ant[13..16].copy_from_slice(&turn([2.0, 0.0, 0.1], heading));
            let seen = View { heading, quarters }.observation(&ant);
            assert!(yaw(&seen).abs() < 1e-12);
            assert_close(&seen[13..16], &[2.0, 0.0, 0.1]);
            assert!((up(&seen) - up(&ant)).abs() < 1e-12);
        }
    }

    #[test]
    fn four_quarters_are_none() {
        let original = ant();
        for quarters in 0..4 {
            let there = View {
                heading: 0.7,
                quarters,
            };
            let back = View {
                heading: -0.7,
                quarters: (4 - quarters) % 4,
            };
            let seen = back.observation(&there.observation(&original));
            assert_close(&seen, &original);
            let action = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8];
            assert_close(&there.action(&back.action(&action)), &action);
        }
    }

    #[test]
    fn a_joint_and_its_motor_move_the_same_leg() {
        // Joints: hip 1 to ankle 4. Actions: hip 4, ankle 4, hip 1, ...
        let order = [6, 7, 0, 1, 2, 3, 4, 5];
        for quarters in 0..4 {
            let view = View {
                heading: 0.0,
                quarters,
            };
            for (action, joint) in order.into_iter().enumerate() {
                let mut meant = [0.0; ACTION_DIM];
                meant[action] = 1.0;
                let done = view.action(&meant);
                // The joints that the motors drive, seen again, are the ones that were meant.
                let mut ant = ant();
                ant[5..13].fill(0.0);
                for (motor, own) in order.into_iter().enumerate() {
                    ant[5 + own] = done[motor];
                }
                let mut expected = [0.0; ACTION_DIM];
                expected[joint] = 1.0;
                assert_eq!(view.observation(&ant)[5..13], expected);
            }
        }
    }
}
