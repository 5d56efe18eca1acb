//! Untrained measure of texture (method 7.3): whether a patch can be told from its neighbours in every direction.
//!
//! Compares the smaller eigenvalue of the structure tensor with that of sensor noise, at the scale of the highest ratio. It lowers confidence
//! only where nothing can be matched: from a few times the noise on, confidence is 1.

use super::{
    ConfidenceMap, Prediction, Predictor,
    features::{Colours, Structure, grid},
    image::Image,
};

/// Standard deviation of the noise of a reduced picture, grey values.
const NOISE: f32 = 1.0;
/// Signal-to-noise ratios (variances) up to which confidence is 0, and from which it is 1.
const NOTHING: f32 = 1.0;
const EVERYTHING: f32 = 6.0;

pub struct Proxy;

impl Predictor for Proxy {
    fn fingerprint(&self) -> blake3::Hash {
        let numbers = [NOISE, NOTHING, EVERYTHING].map(f32::to_le_bytes).concat();
        blake3::hash(&[b"proxy 1", &numbers[..]].concat())
    }

    fn predict(&self, image: &Image) -> Prediction {
        let grid = grid(image.width, image.height);
        let structure = Structure::cells(image, grid);
        let colours = Colours::cells(image, grid);
        let confidence = |(cell, colours): (usize, &Colours)| {
            let ratio = |scale: usize| {
                // The gradient of noise has half its variance, and averaging four pixels leaves a quarter of that.
                let noise = 0.5 * NOISE * NOISE / 4f32.powi(scale as i32);
                structure[scale][cell].eigenvalues()[1] / noise
            };
            let best = (0..structure.len()).map(ratio).fold(0.0, f32::max);
            told_apart(best) * (1.0 - colours.bright - colours.dark).max(0.0)
        };
        let values = colours.iter().enumerate().map(confidence);
        Prediction { map: ConfidenceMap::new(grid, values), distance: 0.0 }
    }
}

/// Rises from 0 to 1 with the logarithm.
fn told_apart(ratio: f32) -> f32 {
    ((ratio / NOTHING).ln() / (EVERYTHING / NOTHING).ln()).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Left half filled by the function, right half blank.
    fn confidence(grey: impl Fn(u32, u32) -> u8) -> (f32, f32) {
        let (width, height) = (128, 64);
        let at = |i: u32| if i % width < width / 2 { grey(i % width, i / width) } else { 120 };
        let rgb = (0..width * height).flat_map(|i| [at(i); 3]).collect();
        let map = Proxy.predict(&Image { width, height, rgb, full: [width, height] }).map;
        (map.value_at(0.2, 0.5), map.value_at(0.8, 0.5))
    }

    fn noise(x: u32, y: u32) -> u32 {
        (x.wrapping_mul(0x9e37_79b1) ^ y.wrapping_mul(0x85eb_ca6b)).wrapping_mul(0xc2b2_ae35) >> 16
    }

    #[test]
    fn texture_is_certain_and_blank_is_not() {
        assert_eq!(confidence(|x, y| 100 + (noise(x, y) % 40) as u8), (1.0, 0.0));
    }

    #[test]
    fn sensor_noise_is_no_texture() {
        assert!(confidence(|x, y| 119 + (noise(x, y) % 3) as u8).0 < 0.3);
    }

    #[test]
    fn an_edge_tells_nothing_along_itself() {
        assert!(confidence(|x, _| if x / 8 % 2 == 0 { 60 } else { 180 }).0 < 0.01);
    }

    #[test]
    fn saturated_and_black_areas_are_lost() {
        assert_eq!(confidence(|x, y| 251 + (noise(x, y) % 5) as u8).0, 0.0);
        assert_eq!(confidence(|x, y| (noise(x, y) % 6) as u8).0, 0.0);
    }
}
