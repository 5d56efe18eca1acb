//! The gate (method 7.1): limits on pairs of views beyond which a backend usually fails.

use super::PairGeometry;
use crate::{
    method::partners::GateSettings,
    model::{cluster::Gate, reason::Reason},
};

impl Gate {
    /// Returns the gate with the limits that the settings override.
    pub fn with(self, set: &GateSettings) -> Self {
        Self {
            min_shared_points: set
                .min_shared_points
                .map_or(self.min_shared_points, |points| points as usize),
            min_angle_deg: set.min_angle.unwrap_or(self.min_angle_deg),
            max_angle_deg: set.max_angle.unwrap_or(self.max_angle_deg),
            max_scale_octaves: set.max_scale_octaves.unwrap_or(self.max_scale_octaves),
            epipole_inside: set.epipole_inside.unwrap_or(self.epipole_inside),
        }
    }

    /// Returns the limits as settings; a limit that no pair exceeds is unset.
    pub fn settings(&self) -> GateSettings {
        GateSettings {
            min_shared_points: u32::try_from(self.min_shared_points).ok(),
            min_angle: Some(self.min_angle_deg),
            max_angle: Some(self.max_angle_deg),
            max_scale_octaves: Some(self.max_scale_octaves).filter(|octaves| octaves.is_finite()),
            epipole_inside: Some(self.epipole_inside),
        }
    }

    /// Returns why the pair cannot be matched; `None` if it can.
    pub fn refusal(&self, pair: &PairGeometry) -> Option<Reason> {
        match self.broken_limit(pair) {
            _ if pair.shared.is_empty() => Some(Reason::NoSharedPoints),
            limit => limit.map(|_| Reason::NotMatchable),
        }
    }

    /// Returns the first limit that the pair exceeds.
    pub fn broken_limit(&self, pair: &PairGeometry) -> Option<PairLimit> {
        if pair.shared.len() < self.min_shared_points {
            Some(PairLimit::FewSharedPoints)
        } else if pair.angle_deg > self.max_angle_deg {
            Some(PairLimit::LargeAngle)
        } else if pair.angle_deg < self.min_angle_deg || pair.angle_deg.is_nan() {
            Some(PairLimit::SmallAngle)
        } else if pair.scale_octaves.abs() > self.max_scale_octaves || pair.scale_octaves.is_nan() {
            Some(PairLimit::Scale)
        } else {
            (!self.epipole_inside && pair.epipole_inside).then_some(PairLimit::Epipole)
        }
    }
}

/// The limit of a [`Gate`] that a pair exceeds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum PairLimit {
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
    fn limits_that_are_set_take_the_place_of_the_backends() {
        let gate = Gate {
            min_angle_deg: 5.0,
            ..Gate::OPEN
        };
        assert_eq!(gate.with(&GateSettings::default()), gate);
        assert_eq!(
            Gate::OPEN.with(&gate.settings()),
            gate,
            "what is in force is a setting that says the same"
        );
        let set = GateSettings {
            min_angle: Some(2.0),
            max_scale_octaves: Some(1.0),
            ..GateSettings::default()
        };
        assert_eq!(
            gate.with(&set),
            Gate {
                min_angle_deg: 2.0,
                max_scale_octaves: 1.0,
                ..gate
            }
        );
    }

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
        for limit in [
            PairGeometry {
                angle_deg: 1.0,
                ..good
            },
            PairGeometry {
                angle_deg: 60.0,
                ..good
            },
            PairGeometry {
                scale_octaves: 0.5,
                ..good
            },
        ] {
            assert_eq!(gate.refusal(&limit), None);
        }
        assert_eq!(
            gate.refusal(&PairGeometry {
                shared: &[],
                ..good
            }),
            Some(Reason::NoSharedPoints)
        );
        for bad in [
            PairGeometry {
                angle_deg: 0.9,
                ..good
            },
            PairGeometry {
                angle_deg: 61.0,
                ..good
            },
            PairGeometry {
                angle_deg: f64::NAN,
                ..good
            },
            PairGeometry {
                scale_octaves: -0.6,
                ..good
            },
            PairGeometry {
                epipole_inside: true,
                ..good
            },
        ] {
            assert_eq!(gate.refusal(&bad), Some(Reason::NotMatchable));
            assert_eq!(Gate::OPEN.refusal(&bad).is_none(), !bad.angle_deg.is_nan());
        }
    }
}
