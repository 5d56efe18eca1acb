//! Pair confidence (method 7.2) of [`LANES`] triangles at a time.

use super::{
    super::lanes::{LANES, Lanes, angle_of_chord, exp2, log2},
    TriangleLanes,
};
use crate::method::confidence::PairConfidence;

/// Returns [`PairConfidence::confidence`], relative error below 1e-6. `rays`: from the partner's
/// centre to the centroids.
#[inline(always)]
pub(super) fn geometric(
    numbers: &PairConfidence,
    triangles: &TriangleLanes,
    rays: &[[f64; LANES]; 3],
) -> Lanes {
    let Constellations {
        cosines,
        ratios,
        chords,
    } = Constellations::new(triangles, rays);
    let mut chance = [numbers.p0 as f32; LANES];
    let power = numbers.cosine_power as f32;
    for i in 0..LANES {
        // Visible triangles face the camera; the results of the others are discarded.
        let cosine = if cosines[i] > 1e-6 { cosines[i] } else { 1e-6 };
        chance[i] *= if power == 1.0 {
            cosine
        } else {
            exp2(power * log2(cosine))
        };
    }
    if let Some(octaves) = numbers.scale_octaves {
        times_scale(&mut chance, octaves, &ratios);
    }
    if let Some(degrees) = numbers.full_angle_deg {
        times_angle(&mut chance, degrees, &chords);
    }
    // Comparisons in this order turn NaN into 0.
    chance.map(|c| {
        if c > 0.0 {
            if c < 1.0 { c } else { 1.0 }
        } else {
            0.0
        }
    })
}

/// What the confidence of a pair depends on, by triangle.
struct Constellations {
    /// Cosine of the larger angle of incidence.
    cosines: Lanes,
    /// Squared distance of the partner over that of the key view.
    ratios: Lanes,
    /// Squared chord between the unit vectors along the two rays.
    chords: Lanes,
}

impl Constellations {
    #[inline(always)]
    fn new(triangles: &TriangleLanes, rays: &[[f64; LANES]; 3]) -> Self {
        let (mut cosines, mut ratios, mut chords) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            let (key, own) = (squared(&triangles.ray, i), squared(rays, i));
            let (to_key, to_own) = (1.0 / key.sqrt(), 1.0 / own.sqrt());
            let (mut dot, mut chord) = (0.0, 0.0);
            for ((normal, key_ray), ray) in triangles.normal.iter().zip(&triangles.ray).zip(rays) {
                dot -= f64::from(normal[i]) * ray[i];
                let apart = key_ray[i] * to_key - ray[i] * to_own;
                chord += apart * apart;
            }
            let cosine = (dot * to_own) as f32;
            cosines[i] = if cosine < triangles.cosine[i] {
                cosine
            } else {
                triangles.cosine[i]
            };
            ratios[i] = (own / key) as f32;
            chords[i] = chord as f32;
        }
        Self {
            cosines,
            ratios,
            chords,
        }
    }
}

#[inline(always)]
fn squared(v: &[[f64; LANES]; 3], i: usize) -> f64 {
    v[0][i] * v[0][i] + v[1][i] * v[1][i] + v[2][i] * v[2][i]
}

/// Multiplies by exp(-x^2 / 2) as a power of 2, where x is half the log2 of the squared ratio,
/// divided by `octaves`.
#[inline(always)]
fn times_scale(chance: &mut Lanes, octaves: f64, ratios: &Lanes) {
    let factor = (-0.125 * std::f64::consts::LOG2_E / (octaves * octaves)) as f32;
    for i in 0..LANES {
        // Lanes without a triangle may hold 0 or NaN, which `log2` does not take.
        let twice = log2(if ratios[i] > 1e-30 { ratios[i] } else { 1e-30 });
        chance[i] *= exp2(factor * twice * twice);
    }
}

/// Multiplies by the triangulation angle over `degrees`, at most 1.
#[inline(always)]
fn times_angle(chance: &mut Lanes, degrees: f64, chords: &Lanes) {
    let per_full = (1.0 / degrees.to_radians()) as f32;
    for i in 0..LANES {
        let share = angle_of_chord(chords[i]) * per_full;
        chance[i] *= if share < 1.0 { share } else { 1.0 };
    }
}
