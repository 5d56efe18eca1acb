//! Geometric confidence of a pair (method 7.2): probability of a match from the geometry of the two
//! views and the triangle. Needs no image. The sparse points around contribute in
//! [`nearby`](super::nearby()).

use nalgebra::Point3;

use crate::{
    method::{confidence::ConfidenceSettings, geometry::Geometry},
    model::scene::ViewIndex,
};

/// Parameters of the geometric confidence (method 7.2); each backend has its own.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct PairConfidence {
    /// Minimum number of successful matches for a pixel (method 3.4), 1 to 3.
    pub min_matches: u32,
    pub p0: f64,
    /// Exponent of the smaller cosine of incidence (gamma). A higher value penalises slanted views
    /// more.
    pub cosine_power: f64,
    /// Standard deviation of the scale ratio, octaves (s); `None`: scale has no effect.
    pub scale_octaves: Option<f64>,
    /// Triangulation angle, degrees, from which the angle no longer lowers the probability (a);
    /// `None`: it never does.
    pub full_angle_deg: Option<f64>,
}

impl PairConfidence {
    /// Returns these parameters with the user's settings in place of theirs.
    pub fn with(&self, settings: &ConfidenceSettings) -> Self {
        let unless_zero = |set: Option<f64>, own: Option<f64>| match set {
            Some(0.0) => None,
            Some(value) => Some(value),
            None => own,
        };
        Self {
            min_matches: settings.min_matches.unwrap_or(self.min_matches),
            p0: settings.p0.unwrap_or(self.p0),
            cosine_power: settings.cosine_power.unwrap_or(self.cosine_power),
            scale_octaves: unless_zero(settings.scale_octaves, self.scale_octaves),
            full_angle_deg: unless_zero(settings.full_angle, self.full_angle_deg),
        }
    }

    /// p_i(t) = p0 min(cos key, cos partner)^gamma exp(-(log2(l_i / l_key) / s)^2 / 2) min(angle /
    /// a, 1), in [0, 1].
    pub fn confidence(&self, c: &Constellation) -> f64 {
        let incidence = c
            .cos_key
            .min(c.cos_partner)
            .max(0.0)
            .powf(self.cosine_power);
        let scale = self
            .scale_octaves
            .map_or(1.0, |s| (-0.5 * (c.octaves / s).powi(2)).exp());
        let angle = self
            .full_angle_deg
            .map_or(1.0, |a| (c.angle_deg / a).min(1.0));
        (self.p0 * incidence * scale * angle).clamp(0.0, 1.0)
    }
}

/// Relative geometry of key view, partner and triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Constellation {
    /// Cosine of the angle between the triangle's normal and the direction to the key view.
    pub cos_key: f64,
    pub cos_partner: f64,
    /// log2 of the partner's distance relative to the key view's, centroid to camera centre.
    pub octaves: f64,
    /// Angle between the directions from the centroid to the two camera centres, degrees.
    pub angle_deg: f64,
}

impl Constellation {
    pub fn new(geometry: &Geometry, key: ViewIndex, partner: ViewIndex, triangle: u32) -> Self {
        let [key, partner] = [key, partner].map(|v| geometry.scene.view(v).cam_from_world.centre());
        let normal = geometry.surface.area_normal(triangle);
        let centroid = geometry.surface.centroid(triangle);
        let to = |centre: Point3<f64>| centre - centroid;
        let cosine = |centre| normal.dot(&to(centre)) / (normal.norm() * to(centre).norm());
        Self {
            cos_key: cosine(key),
            cos_partner: cosine(partner),
            octaves: (to(partner).norm() / to(key).norm()).log2(),
            angle_deg: to(key).angle(&to(partner)).to_degrees(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SURE: PairConfidence = PairConfidence {
        min_matches: 2,
        p0: 0.8,
        cosine_power: 1.0,
        scale_octaves: Some(0.7),
        full_angle_deg: None,
    };

    #[test]
    fn follows_its_formula() {
        let frontal = Constellation {
            cos_key: 1.0,
            cos_partner: 1.0,
            octaves: 0.0,
            angle_deg: 4.0,
        };
        assert_eq!(SURE.confidence(&frontal), 0.8);
        let aside = Constellation {
            cos_partner: 0.5,
            ..frontal
        };
        assert_eq!(SURE.confidence(&aside), 0.4);
        let finer = Constellation {
            octaves: -0.7,
            ..frontal
        };
        assert!((SURE.confidence(&finer) - 0.8 * (-0.5f64).exp()).abs() < 1e-15);
        let patch_match = PairConfidence {
            full_angle_deg: Some(8.0),
            scale_octaves: None,
            ..SURE
        };
        assert_eq!(
            patch_match.confidence(&Constellation {
                octaves: 3.0,
                ..frontal
            }),
            0.4
        );
    }

    #[test]
    fn settings_replace_the_backends_numbers() {
        let settings = ConfidenceSettings {
            p0: Some(0.5),
            scale_octaves: Some(0.0),
            ..Default::default()
        };
        assert_eq!(
            SURE.with(&settings),
            PairConfidence {
                p0: 0.5,
                scale_octaves: None,
                ..SURE
            }
        );
    }
}
