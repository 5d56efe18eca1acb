//! Places a model on earth by positions of its cameras, most of which are right: the similarity
//! with the least median of squared distances over random triples (Rousseeuw 1984), then least
//! squares over the inliers (Umeyama 1991).

use nalgebra::{Matrix3, SVD, Vector3};
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::base::median::upper_median;

/// Number of random triples; 200 contain one of three right positions with 0.99999 where 40 % are
/// wrong.
const TRIPLES: usize = 200;
/// Fewest positions that are fitted, and that must fit.
const LEAST: usize = 4;
/// Inliers: distance over the robust standard deviation.
const INLIER: f64 = 2.5;
/// Largest residual over the second largest extent of the positions: a larger one leaves the turn
/// around the line of flight open.
const LOOSE: f64 = 0.25;

/// Scale, rotation and translation from the model to metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Rotation times scale.
    pub linear: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl Similarity {
    fn apply(&self, x: &Vector3<f64>) -> Vector3<f64> {
        self.linear * x + self.translation
    }
}

/// A similarity with its support.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    pub similarity: Similarity,
    /// Positions that fit.
    pub inliers: usize,
    /// Median distance of those from the model's cameras, metres.
    pub median: f64,
}

/// Fits camera centres of the model (`from`) to their positions in a metric frame (`to`), in the
/// same order; `None` if fewer than four or half of them agree, or if they leave the rotation open.
pub fn fit(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Option<Fit> {
    let n = from.len();
    if n < LEAST {
        return None;
    }
    let (best, inliers) = refined(least_median(from, to)?, from, to)?;
    let distances = distances(&best, from, to);
    let fitting = median_distance(inliers.iter().map(|&i| distances[i]));
    let second = extents(inliers.iter().map(|&i| to[i]))[1];
    let is_sure = inliers.len() >= LEAST && 2 * inliers.len() >= n && fitting <= LOOSE * second;
    is_sure.then_some(Fit {
        similarity: best,
        inliers: inliers.len(),
        median: fitting,
    })
}

/// Fits a similarity to its inliers, several times; returns the last with those that it was fitted
/// to.
fn refined(
    mut best: Similarity,
    from: &[Vector3<f64>],
    to: &[Vector3<f64>],
) -> Option<(Similarity, Vec<usize>)> {
    let n = from.len();
    let mut inliers = Vec::new();
    for _ in 0..3 {
        let near = distances(&best, from, to);
        let spread = median_distance(near.iter().copied());
        // 1.4826: a median of absolute values as a standard deviation of normal errors.
        // 1 + 5 / (n - p): correction for few positions (Rousseeuw, Leroy 1987), p those of a fit.
        let limit = INLIER * 1.4826 * spread * (1.0 + 5.0 / (n as f64 - 3.0).max(1.0));
        inliers = (0..n).filter(|&i| near[i] <= limit).collect();
        best = least_squares(from, to, &inliers)?;
    }
    Some((best, inliers))
}

/// Returns the similarity by one of the random triples that has the least median distance.
fn least_median(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Option<Similarity> {
    // A fixed seed: the same positions give the same place.
    let mut random = Pcg64Mcg::seed_from_u64(0);
    let mut draw = || (random.next_u64() % from.len() as u64) as usize;
    let triples = (0..TRIPLES)
        .map(|_| [draw(), draw(), draw()])
        .filter(|[a, b, c]| a != b && b != c && a != c);
    let candidates = triples.filter_map(|triple| least_squares(from, to, &triple));
    let rated = candidates.map(|similarity| {
        (
            median_distance(distances(&similarity, from, to)),
            similarity,
        )
    });
    let (_, best) = rated.min_by(|a, b| a.0.total_cmp(&b.0))?;
    Some(best)
}

fn distances(similarity: &Similarity, from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Vec<f64> {
    from.iter()
        .zip(to)
        .map(|(from, to)| (similarity.apply(from) - to).norm())
        .collect()
}

/// Median of distances; infinite where there are none.
fn median_distance(distances: impl IntoIterator<Item = f64>) -> f64 {
    upper_median(distances).unwrap_or(f64::INFINITY)
}

fn mean(points: impl Iterator<Item = Vector3<f64>> + Clone) -> Vector3<f64> {
    points.clone().sum::<Vector3<f64>>() / points.count().max(1) as f64
}

/// Standard deviations of the points along their principal axes, descending.
fn extents(points: impl Iterator<Item = Vector3<f64>> + Clone) -> [f64; 3] {
    let (centre, count) = (mean(points.clone()), points.clone().count().max(1) as f64);
    let covariance: Matrix3<f64> = points
        .map(|p| (p - centre) * (p - centre).transpose())
        .sum();
    let mut values = (covariance / count)
        .symmetric_eigenvalues()
        .map(|value| value.max(0.0).sqrt());
    values.as_mut_slice().sort_by(|a, b| b.total_cmp(a));
    values.into()
}

/// The similarity of least squared distances between the chosen points; `None` if they are at one
/// place or on one line.
fn least_squares(
    from: &[Vector3<f64>],
    to: &[Vector3<f64>],
    chosen: &[usize],
) -> Option<Similarity> {
    let a = chosen.iter().map(|&i| from[i]);
    let b = chosen.iter().map(|&i| to[i]);
    let (centre_a, centre_b) = (mean(a.clone()), mean(b.clone()));
    let products = a
        .clone()
        .zip(b)
        .map(|(a, b)| (b - centre_b) * (a - centre_a).transpose());
    let (rotation, stretch) = rotation(products.sum())?;
    let variance: f64 = a.map(|a| (a - centre_a).norm_squared()).sum();
    let scale = stretch / variance;
    let linear = rotation * scale;
    (variance > 0.0 && scale > 0.0 && scale.is_finite()).then(|| Similarity {
        linear,
        translation: centre_b - linear * centre_a,
    })
}

/// Returns the rotation nearest to a covariance, and the sum of the signed singular values; `None`
/// if only one of these differs from 0.
fn rotation(covariance: Matrix3<f64>) -> Option<(Matrix3<f64>, f64)> {
    let SVD {
        u,
        v_t,
        singular_values,
    } = covariance.svd(true, true);
    let (u, v_t) = (u?, v_t?);
    if singular_values[1] <= 1e-9 * singular_values[0] {
        return None;
    }
    let mut signs = Vector3::new(1.0, 1.0, 1.0);
    // The smallest singular value is last.
    signs[2] = (u.determinant() * v_t.determinant()).signum();
    let rotation = u * Matrix3::from_diagonal(&signs) * v_t;
    Some((rotation, singular_values.dot(&signs)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;

    /// Cameras of a survey, and where they are on earth: turned, scaled by 12.5, and with errors up
    /// to `noise` metres.
    fn survey(noise: f64) -> (Vec<Vector3<f64>>, Vec<Vector3<f64>>, Matrix3<f64>) {
        let from: Vec<_> = (0..40)
            .map(|i| Vector3::new(f64::from(i % 8), f64::from(i / 8), f64::from(i % 3) * 0.1))
            .collect();
        let linear = Rotation3::from_euler_angles(0.3, -1.2, 2.0).into_inner() * 12.5;
        let error = |i: usize| {
            Vector3::new(((i * 7) % 5) as f64 - 2.0, ((i * 3) % 5) as f64 - 2.0, 0.0)
                * (noise / 2.0)
        };
        let to = from
            .iter()
            .enumerate()
            .map(|(i, x)| linear * x + Vector3::new(5.0, -7.0, 100.0) + error(i))
            .collect();
        (from, to, linear)
    }

    #[test]
    fn a_third_of_wrong_positions_changes_nothing() {
        let (from, mut to, linear) = survey(0.0);
        to.iter_mut()
            .step_by(3)
            .for_each(|position| position.x += 400.0);
        let fit = fit(&from, &to).unwrap();
        assert_eq!(fit.inliers, 26);
        assert!((fit.similarity.linear - linear).norm() < 1e-6 && fit.median < 1e-6);
    }

    #[test]
    fn errors_of_positions_are_measured() {
        let (from, to, linear) = survey(1.0);
        let fit = fit(&from, &to).unwrap();
        assert!(
            fit.inliers >= 36 && (0.3..1.5).contains(&fit.median),
            "{fit:?}"
        );
        assert!((fit.similarity.linear - linear).norm() < 0.3);
    }

    #[test]
    fn positions_on_a_line_or_at_random_place_nothing() {
        let (from, to, _) = survey(0.0);
        let line: Vec<_> = from.iter().map(|x| Vector3::new(x.x, 0.0, 0.0)).collect();
        assert_eq!(fit(&line, &line), None);
        let random: Vec<_> = (0..40)
            .map(|i| {
                Vector3::new(
                    f64::from(i * i % 17),
                    f64::from(i * 7 % 13),
                    f64::from(i * 5 % 11),
                )
            })
            .collect();
        assert_eq!(fit(&from, &random), None);
        assert_eq!(fit(&from[..3], &to[..3]), None);
    }
}
