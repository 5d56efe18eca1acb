//! Belief in the prediction after finished depth maps (method 5.4): a triangle that failed is not
//! tried again from a neighbouring view.
//!
//! The prediction says which share of a triangle's pixels a cluster measures (its f_conf). Finished
//! clusters update a Beta distribution over "is matched as predicted": predicted pixels are trials,
//! measured ones successes, weighted by the similarity of the two key views, with a prior of
//! [`TRUST`] successes. Its mean multiplies the confidence of the remaining clusters. It is 1 if
//! nothing fell short of the prediction.

use nalgebra::Vector3;

use crate::{
    base::rows::Offsets,
    method::fulfilment::FulfilmentTable,
    model::{
        cluster::ViewCluster,
        scene::{Scene, ViewIndex},
        surface::Surface,
    },
};

/// Prior: successes before the first trial.
const TRUST: f32 = 0.3;
/// Correlation of the pixels of a triangle: even a large one counts as at most 1 / `CORRELATION`
/// trials.
const CORRELATION: f32 = 0.2;
/// Angle between viewing directions, degrees, at which similarity is exp(-1/2).
const DIRECTION_DEG: f64 = 45.0;
/// Ratio of ground sampling distances, octaves, at which similarity is exp(-1/2).
const SCALE_OCTAVES: f64 = 1.5;

/// Result of a finished cluster at a triangle that its key view sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attempt {
    pub triangle: u32,
    /// Independent pixels that were predicted to be measured.
    pub promised: f32,
    /// Independent pixels that were measured.
    pub kept: f32,
}

impl Attempt {
    /// Builds the result from the number of pixels that show the triangle and the predicted and
    /// measured shares of them, 0 to 1. A surplus at one triangle does not offset a shortfall at
    /// another.
    pub fn new(triangle: u32, pixels: u32, predicted: f32, measured: f32) -> Self {
        // A triangle may be visible and yet cover no centre of a pixel.
        let pixels = pixels.max(1) as f32;
        let independent = pixels / (1.0 + (pixels - 1.0) * CORRELATION);
        Self {
            triangle,
            promised: independent * predicted,
            kept: independent * predicted.min(measured),
        }
    }
}

/// Belief for each entry of a table of predicted fulfilment.
pub struct Beliefs<'a> {
    scene: &'a Scene,
    surface: &'a Surface,
    /// Key view of each cluster of the table.
    keys: Vec<ViewIndex>,
    predicted: &'a FulfilmentTable,
    /// Entries of the table by triangle, with their cluster (CSR).
    offsets: Offsets,
    entries: Vec<(u32, usize)>,
    promised: Vec<f32>,
    kept: Vec<f32>,
}

impl<'a> Beliefs<'a> {
    /// Starts with the prior. `predicted`: a row per cluster.
    pub fn new(
        scene: &'a Scene,
        surface: &'a Surface,
        clusters: &[ViewCluster],
        predicted: &'a FulfilmentTable,
    ) -> Self {
        let of_cluster = |cluster: usize| {
            let row = predicted.offsets[cluster]..predicted.offsets[cluster + 1];
            row.map(move |entry| {
                let triangle = predicted.triangles[entry] as usize;
                (triangle, (cluster as u32, entry))
            })
        };
        let all = || (0..predicted.clusters()).flat_map(of_cluster);
        let (offsets, entries) = Offsets::sorted(surface.triangles.len(), all);
        let none = vec![0.0; predicted.triangles.len()];
        let keys = clusters.iter().map(|cluster| cluster.key).collect();
        Self {
            scene,
            surface,
            keys,
            predicted,
            offsets,
            entries,
            promised: none.clone(),
            kept: none,
        }
    }

    /// Adds the results of a finished cluster with this key view.
    pub fn learn(&mut self, key: ViewIndex, attempts: &[Attempt]) {
        for attempt in attempts.iter().filter(|attempt| attempt.promised > 0.0) {
            let look = ViewingGeometry::new(self.scene, self.surface, key, attempt.triangle);
            let t = attempt.triangle as usize;
            for &(cluster, entry) in &self.entries[self.offsets.row(t)] {
                let other = ViewingGeometry::new(
                    self.scene,
                    self.surface,
                    self.keys[cluster as usize],
                    attempt.triangle,
                );
                let alike = look.similarity(&other) as f32;
                self.promised[entry] += alike * attempt.promised;
                self.kept[entry] += alike * attempt.kept;
            }
        }
    }

    /// Returns the triangles of a cluster with its expected f.
    pub fn row(&self, cluster: usize) -> (&'a [u32], Vec<f32>) {
        let (triangles, values) = self.predicted.row(cluster);
        let first = self.predicted.offsets[cluster];
        let believed = values
            .iter()
            .enumerate()
            .map(|(i, f)| f * self.mean(first + i))
            .collect();
        (triangles, believed)
    }

    fn mean(&self, entry: usize) -> f32 {
        (TRUST + self.kept[entry]) / (TRUST + self.promised[entry])
    }
}

/// Direction and scale at which a view sees a triangle.
struct ViewingGeometry {
    /// Unit vector from the centroid to the camera.
    direction: Vector3<f64>,
    /// Scene units per pixel, up to a factor common to all views.
    gsd: f64,
}

impl ViewingGeometry {
    fn new(scene: &Scene, surface: &Surface, view: ViewIndex, triangle: u32) -> Self {
        let ray = scene.view(view).cam_from_world.centre() - surface.centroid(triangle);
        let distance = ray.norm();
        Self {
            direction: ray / distance,
            gsd: distance / scene.camera_of(view).mean_focal_length(),
        }
    }

    /// Returns the similarity: 1 if equal, falling with the angle between the directions and the
    /// octaves between the scales.
    fn similarity(&self, other: &Self) -> f64 {
        let angle = self
            .direction
            .dot(&other.direction)
            // Rounding may take the product of equal directions beyond 1, where acos is NaN.
            .clamp(-1.0, 1.0)
            .acos()
            .to_degrees();
        let octaves = (self.gsd / other.gsd).log2();
        let distance = (angle / DIRECTION_DEG).powi(2) + (octaves / SCALE_OCTAVES).powi(2);
        let alike = (-0.5 * distance).exp();
        // A camera in the triangle has no direction.
        if alike.is_finite() { alike } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        method::synthetic::Town,
        model::camera::{Camera, CameraModel},
    };

    /// All views see triangle 0, with a prediction of 0.8.
    struct Fixture {
        scene: Scene,
        surface: Surface,
        clusters: Vec<ViewCluster>,
        predicted: FulfilmentTable,
    }

    impl Fixture {
        fn new() -> Self {
            let town = Town::new(
                Camera::new(
                    1,
                    CameraModel::Pinhole,
                    300,
                    225,
                    vec![280.0, 280.0, 150.0, 112.5],
                )
                .unwrap(),
            );
            let (scene, surface) = (town.scene(), town.surface());
            let predicted =
                FulfilmentTable::new(scene.view_indices().map(|_| [(0, 0.8), (1, 0.4)]));
            let clusters = scene
                .view_indices()
                .map(|key| ViewCluster {
                    key,
                    partners: Vec::new(),
                })
                .collect();
            Self {
                scene,
                surface,
                clusters,
                predicted,
            }
        }

        fn beliefs(&self) -> Beliefs<'_> {
            Beliefs::new(&self.scene, &self.surface, &self.clusters, &self.predicted)
        }
    }

    #[test]
    fn pixels_of_a_triangle_are_not_independent() {
        let promised = |pixels| Attempt::new(0, pixels, 1.0, 1.0).promised;
        assert_eq!([0, 1, 6].map(promised), [1.0, 1.0, 3.0]);
        let short = Attempt::new(0, 6, 0.5, 0.25);
        assert_eq!((short.promised, short.kept), (1.5, 0.75));
        assert_eq!(Attempt::new(0, 6, 0.25, 0.5).kept, 0.75);
    }

    #[test]
    fn kept_promises_change_nothing() {
        let fixture = Fixture::new();
        let mut beliefs = fixture.beliefs();
        beliefs.learn(
            ViewIndex(0),
            &[Attempt::new(0, 40, 0.7, 0.7), Attempt::new(1, 3, 0.2, 1.0)],
        );
        for cluster in 0..fixture.clusters.len() {
            let (triangles, row) = beliefs.row(cluster);
            assert_eq!((triangles, row.as_slice()), fixture.predicted.row(cluster));
        }
    }

    #[test]
    fn what_failed_is_expected_to_fail_from_next_door_and_less_so_from_elsewhere() {
        let fixture = Fixture::new();
        let mut beliefs = fixture.beliefs();
        let key = ViewIndex(0);
        let attempt = Attempt::new(0, 1000, 0.9, 0.0);
        beliefs.learn(key, &[attempt]);
        let own = ViewingGeometry::new(&fixture.scene, &fixture.surface, key, 0);
        let alike = |c: usize| {
            own.similarity(&ViewingGeometry::new(
                &fixture.scene,
                &fixture.surface,
                fixture.clusters[c].key,
                0,
            ))
        };
        let mut by_likeness: Vec<usize> = (0..fixture.clusters.len()).collect();
        by_likeness.sort_by(|&a, &b| alike(b).total_cmp(&alike(a)));
        let values: Vec<f32> = by_likeness.iter().map(|&c| beliefs.row(c).1[0]).collect();
        assert_eq!(by_likeness[0], 0);
        assert!(values[0] < 0.3 * 0.8, "tried from there: {}", values[0]);
        assert!(values.windows(2).all(|w| w[0] <= w[1]));
        assert!(
            values[values.len() - 1] > 2.0 * values[0],
            "not tried from there: {}",
            values[values.len() - 1]
        );
        for (&c, value) in by_likeness.iter().zip(&values) {
            let expected = 0.8 * TRUST / (TRUST + alike(c) as f32 * attempt.promised);
            assert!((value - expected).abs() < 1e-6, "{value} {expected}");
        }
        assert!(
            by_likeness.iter().all(|&c| beliefs.row(c).1[1] == 0.4),
            "the other triangle was not tried"
        );
    }

    #[test]
    fn more_failures_are_believed_more_and_successes_beside_them_count() {
        let fixture = Fixture::new();
        let failed = Attempt::new(0, 10, 0.9, 0.0);
        let after = |attempts: &[Attempt]| {
            let mut beliefs = fixture.beliefs();
            attempts
                .iter()
                .for_each(|attempt| beliefs.learn(ViewIndex(3), &[*attempt]));
            beliefs.row(3).1[0]
        };
        assert!(after(&[failed, failed]) < after(&[failed]));
        assert!(after(&[failed]) < after(&[failed, Attempt::new(0, 10, 0.9, 0.9)]));
        assert!(
            after(&[Attempt::new(0, 1000, 0.9, 0.0)]) < after(&[failed]),
            "more pixels failed"
        );
        let (huge, large) = (
            Attempt::new(0, 100_000, 0.9, 0.0),
            Attempt::new(0, 1000, 0.9, 0.0),
        );
        assert!(
            (after(&[huge]) - after(&[large])).abs() < 0.01,
            "pixels of a triangle fail together"
        );
    }

    #[test]
    fn looks_are_alike_by_direction_and_scale() {
        let look = |degrees: f64, gsd: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            ViewingGeometry {
                direction: Vector3::new(sin, 0.0, cos),
                gsd,
            }
        };
        let e = (-0.5f64).exp();
        assert_eq!(look(0.0, 1.0).similarity(&look(0.0, 1.0)), 1.0);
        assert!((look(0.0, 1.0).similarity(&look(DIRECTION_DEG, 1.0)) - e).abs() < 1e-9);
        assert!((look(30.0, 1.0).similarity(&look(30.0, SCALE_OCTAVES.exp2())) - e).abs() < 1e-6);
        assert_eq!(look(f64::NAN, 1.0).similarity(&look(0.0, 1.0)), 0.0);
    }
}
