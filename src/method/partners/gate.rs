//! Method 7.1: which pairs of views a backend can match at all.

use super::PairGeometry;
use crate::model::{cluster::Gate, reason::Reason};

impl Gate {
    /// Why the pair cannot be matched; `None`: it can.
    pub fn refusal(&self, pair: &PairGeometry) -> Option<Reason> {
        match self.obstacle(pair) {
            _ if pair.shared.is_empty() => Some(Reason::NoSharedPoints),
            obstacle => obstacle.map(|_| Reason::NotMatchable),
        }
    }

    /// The first of its limits that the pair exceeds.
    pub fn obstacle(&self, pair: &PairGeometry) -> Option<Obstacle> {
        if pair.shared.len() < self.min_shared_points {
            Some(Obstacle::FewSharedPoints)
        } else if pair.angle_deg > self.max_angle_deg {
            Some(Obstacle::LargeAngle)
        } else if pair.angle_deg < self.min_angle_deg || pair.angle_deg.is_nan() {
            Some(Obstacle::SmallAngle)
        } else if pair.scale_octaves.abs() > self.max_scale_octaves || pair.scale_octaves.is_nan() {
            Some(Obstacle::Scale)
        } else {
            (!self.epipole_inside && pair.epipole_inside).then_some(Obstacle::Epipole)
        }
    }
}

/// Which limit of a [`Gate`] a pair exceeds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Obstacle {
    FewSharedPoints,
    SmallAngle,
    LargeAngle,
    Scale,
    Epipole,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::scene::{PointIndex, Scene, ViewIndex};

    #[test]
    fn a_gate_refuses_what_is_outside_of_it() {
        let gate = Gate {
            min_shared_points: 1,
            min_angle_deg: 1.0,
            max_angle_deg: 60.0,
            max_scale_octaves: 0.5,
            epipole_inside: false,
        };
        let scene = Scene::default();
        let good = PairGeometry {
            scene: &scene,
            key: ViewIndex(0),
            partner: ViewIndex(1),
            shared: &[PointIndex(3)],
            angle_deg: 10.0,
            still_share: 0.0,
            scale_octaves: -0.4,
            epipole_inside: false,
        };
        assert_eq!(gate.refusal(&good), None);
        assert_eq!(gate.refusal(&PairGeometry { shared: &[], ..good }), Some(Reason::NoSharedPoints));
        for bad in [
            PairGeometry { angle_deg: 0.9, ..good },
            PairGeometry { angle_deg: 61.0, ..good },
            PairGeometry { angle_deg: f64::NAN, ..good },
            PairGeometry { scale_octaves: -0.6, ..good },
            PairGeometry { epipole_inside: true, ..good },
        ] {
            assert_eq!(gate.refusal(&bad), Some(Reason::NotMatchable));
            assert_eq!(Gate::OPEN.refusal(&bad).is_none(), !bad.angle_deg.is_nan());
        }
    }
}
