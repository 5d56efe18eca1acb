use super::*;
use crate::progress::Unwatched;

fn points(count: usize, seed: u64, scale: f64) -> Vec<Point3<f64>> {
    let mut random = Random(seed);
    (0..count).map(|_| Point3::new(random.unit() * scale, random.unit() * scale, random.unit() * scale)).collect()
}

struct Random(u64);
impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        self.0 >> 33
    }
    fn unit(&mut self) -> f64 {
        self.next() as f64 / (1u64 << 31) as f64
    }
}

fn triangulated(points: &[Point3<f64>]) -> Delaunay {
    let delaunay = Delaunay::triangulate(points, &Unwatched).expect("valid input");
    assert_eq!(delaunay.validate(), Ok(()));
    delaunay
}

#[test]
fn random_points() {
    for count in [4, 5, 6, 10, 100, 3000] {
        assert_eq!(triangulated(&points(count, count as u64, 1.0)).dimension, Dimension::Three);
    }
}

#[test]
fn lattice() {
    let lattice =
        |n: i32| (0..n * n * n).map(move |i| Point3::new(f64::from(i % n), f64::from(i / n % n), f64::from(i / n / n)));
    for n in [2, 3, 5, 9] {
        triangulated(&lattice(n).collect::<Vec<_>>());
    }
}

/// Every ray reaches its target or the outside, meets triangles of its own line only, and moves forward.
#[test]
fn rays_reach_their_targets() {
    let mut cloud = points(400, 5, 1.0);
    cloud.extend((0..125).map(|i| Point3::new(f64::from(i % 5), f64::from(i / 5 % 5), f64::from(i / 25)) * 0.25));
    let delaunay = triangulated(&cloud);
    let mut targets = points(20, 6, 3.0);
    targets.extend(cloud.iter().step_by(7).copied());
    for vertex in (0..delaunay.vertex_count() as u32).step_by(5) {
        for target in &targets {
            let mut ray = delaunay.ray(vertex, target);
            let mut cell = ray.cell();
            let mut last = 0.0;
            for crossing in ray.by_ref() {
                assert_eq!(crossing.facet.cell(), cell);
                assert!(crossing.t >= last && crossing.t <= 1.0);
                last = crossing.t;
                cell = delaunay.neighbour(crossing.facet).cell();
            }
            assert!(ray.cell() == cell);
        }
    }
}
