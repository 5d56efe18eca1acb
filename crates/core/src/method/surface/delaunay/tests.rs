use super::grid::{HALF_RANGE, Site};
use super::predicates::{collinear, in_sphere, orient};
use super::ray::{Crossing, Ray};
use super::validate::Flaw;
use super::*;
use crate::base::progress::NoWatcher;
use proptest::prelude::*;
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use robust::Coord3D;
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicU32, Ordering};

fn triangulated(points: &[Point3<f64>]) -> Delaunay {
    let delaunay = Delaunay::triangulate(points, &NoWatcher).expect("valid input");
    assert_eq!(delaunay.validate(), Ok(()));
    for (point, &vertex) in points.iter().zip(&delaunay.vertex_of_point) {
        let distance = (delaunay.position(vertex) - point).amax();
        assert!(
            distance <= 0.5 * delaunay.step(),
            "{point} became {}",
            delaunay.position(vertex)
        );
    }
    delaunay
}

/// Points with whole coordinates from 0 to `range` − 1: the grid does not move them.
fn whole_points(count: usize, range: u64, seed: u64) -> Vec<Point3<f64>> {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    (0..count)
        .map(|_| Point3::from([(); 3].map(|()| (random.next_u64() % range) as f64)))
        .collect()
}

fn lattice(side: u32) -> Vec<Point3<f64>> {
    (0..side.pow(3))
        .map(|i| Point3::from([i % side, i / side % side, i / side / side].map(f64::from)))
        .collect()
}

/// The whole points on a sphere about the origin.
fn whole_sphere(squared_radius: i32) -> Vec<Point3<f64>> {
    let radius = squared_radius.isqrt();
    let side = 2 * radius + 1;
    (0..side.pow(3))
        .map(|i| {
            [
                i % side - radius,
                i / side % side - radius,
                i / side / side - radius,
            ]
        })
        .filter(|p| p.iter().map(|v| v * v).sum::<i32>() == squared_radius)
        .map(|p| Point3::from(p.map(f64::from)))
        .collect()
}

/// Finite cells by the positions of their corners.
fn finite_cells(delaunay: &Delaunay) -> BTreeSet<[[i64; 3]; 4]> {
    let corners = |cell: &Cell| {
        let mut corners = cell.vertices.map(|v| {
            let p = delaunay.position(v);
            [p.x as i64, p.y as i64, p.z as i64]
        });
        corners.sort_unstable();
        corners
    };
    delaunay
        .cells
        .iter()
        .filter(|cell| cell.vertices[3] != INFINITE)
        .map(corners)
        .collect()
}

fn volume(delaunay: &Delaunay) -> f64 {
    let cells = delaunay
        .cells
        .iter()
        .filter(|cell| cell.vertices[3] != INFINITE);
    let volume = |cell: &Cell| {
        let [a, b, c, d] = cell.vertices.map(|v| delaunay.position(v));
        (b - a).cross(&(c - a)).dot(&(d - a))
    };
    cells.map(volume).sum::<f64>() / 6.0
}

#[test]
fn random_points() {
    for count in [4, 5, 6, 10, 100, 3000] {
        assert_eq!(
            triangulated(&whole_points(count, 1 << 20, count as u64)).dimension,
            Dimension::Three
        );
    }
}

/// All spheres are empty of all points, told by expansion arithmetic.
#[test]
fn spheres_are_empty() {
    for points in [
        whole_points(120, 1 << 23, 1),
        whole_points(200, 6, 2),
        lattice(5),
        whole_sphere(81),
    ] {
        let delaunay = triangulated(&points);
        let coordinates: Vec<_> = (0..delaunay.vertex_count() as u32)
            .map(|v| delaunay.position(v))
            .map(|p| Coord3D {
                x: p.x,
                y: p.y,
                z: p.z,
            })
            .collect();
        for cell in delaunay
            .cells
            .iter()
            .filter(|cell| cell.vertices[3] != INFINITE)
        {
            let [a, b, c, d] = cell.vertices.map(|v| coordinates[v as usize]);
            assert!(robust::orient3d(a, b, c, d) < 0.0);
            // Positive orientation there is ours with two corners exchanged.
            assert!(
                coordinates
                    .iter()
                    .all(|&p| robust::insphere(b, a, c, d, p) <= 0.0)
            );
        }
    }
}

#[test]
fn lattices_are_filled() {
    for side in [2, 3, 5, 9] {
        let delaunay = triangulated(&lattice(side));
        assert_eq!(volume(&delaunay), f64::from(side - 1).powi(3));
    }
}

/// The last vertex removes all cells of a sphere: more than the table of edges takes.
#[test]
fn cavities_of_any_size() {
    let sphere = whole_sphere(9801);
    assert!(sphere.len() > 500);
    let mut points = sphere.clone();
    points.push(Point3::origin());
    let delaunay = triangulated(&points);
    let centre = delaunay.vertex_of_point[sphere.len()];
    let finite = delaunay
        .cells
        .iter()
        .filter(|cell| cell.vertices[3] != INFINITE);
    assert!(
        finite.clone().count() > 2 * 500
            && finite.clone().all(|cell| cell.vertices.contains(&centre))
    );
}

#[test]
fn flat_input_is_told_not_refused() {
    let dimension = |points: &[[f64; 3]]| {
        let points: Vec<_> = points.iter().copied().map(Point3::from).collect();
        triangulated(&points).dimension
    };
    assert_eq!(dimension(&[]), Dimension::Zero);
    assert_eq!(dimension(&[[1.0, 2.0, 3.0]]), Dimension::Zero);
    assert_eq!(dimension(&[[1.0, 2.0, 3.0]; 7]), Dimension::Zero);
    assert_eq!(
        dimension(&[[1.0, 2.0, 3.0], [1.0, 2.0, 4.0]]),
        Dimension::One
    );
    assert_eq!(
        dimension(&[[0.0; 3], [1.0; 3], [2.0; 3], [5.0; 3]]),
        Dimension::One
    );
    assert_eq!(
        dimension(&[[0.0; 3], [1.0; 3], [2.0, 1.0, 1.0]]),
        Dimension::Two
    );
    assert_eq!(
        dimension(&[[0.0; 3], [1.0; 3], [2.0, 1.0, 1.0], [4.0, 3.0, 3.0]]),
        Dimension::Two
    );
    assert_eq!(
        dimension(&[[0.0; 3], [1.0; 3], [2.0, 1.0, 1.0], [4.0, 3.0, 3.5]]),
        Dimension::Three
    );
}

#[test]
fn duplicates_become_one_vertex() {
    let distinct = whole_points(100, 1000, 3);
    let points: Vec<_> = (0..1000).map(|i| distinct[i * 37 % 100]).collect();
    let delaunay = triangulated(&points);
    assert_eq!(delaunay.vertex_count(), 100);
    assert_eq!(
        finite_cells(&delaunay),
        finite_cells(&triangulated(&distinct))
    );
}

/// Offsets like those of map coordinates lose nothing: the same cells as without.
#[test]
fn offsets_change_nothing() {
    let points = whole_points(500, 1 << 16, 4);
    let offset = nalgebra::Vector3::new(400_000.0, 5_400_000.0, 300.0);
    let moved: Vec<_> = points.iter().map(|p| p / 64.0 + offset).collect();
    let back = |p: Point3<f64>| (p - offset) * 64.0;
    let (here, there) = (triangulated(&points), triangulated(&moved));
    assert_eq!(here.cells, there.cells);
    assert!(
        (0..500).all(|v| here.position(v) == Point3::origin() + back(there.position(v)).coords)
    );
}

#[test]
fn coordinates_of_any_magnitude() {
    for scale in [1e-310, 1e-300, 1e-30, 1e30, 1e300, 2e303] {
        let points: Vec<_> = whole_points(50, 1 << 16, 5)
            .iter()
            .map(|p| (p - Point3::new(3e4, 3e4, 3e4)) * scale)
            .collect();
        let points: Vec<_> = points.into_iter().map(Point3::from).collect();
        let delaunay = Delaunay::triangulate(&points, &NoWatcher).expect("finite points");
        assert_eq!(delaunay.validate(), Ok(()));
        // Below the smallest step everything falls together.
        assert_eq!(
            delaunay.dimension,
            if scale < 1e-309 {
                Dimension::Zero
            } else {
                Dimension::Three
            },
            "{scale}"
        );
    }
}

#[test]
fn refuses_what_is_no_point() {
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let mut points = whole_points(10, 100, 6);
        points[7].y = bad;
        let refused = Delaunay::triangulate(&points, &NoWatcher);
        assert!(matches!(
            refused,
            Err(DelaunayError::NotFinite { point: 7 })
        ));
    }
}

/// n points on each of two skew lines have (n − 1)² cells: few are triangulated, many refused
/// before memory runs out.
#[test]
fn quadratic_size_is_refused() {
    let lines = |n: i32| -> Vec<Point3<f64>> {
        (0..n)
            .flat_map(|i| {
                [
                    Point3::new(f64::from(i), 0.0, 0.0),
                    Point3::new(0.0, f64::from(i), 9000.0),
                ]
            })
            .collect()
    };
    let few = triangulated(&lines(50));
    assert_eq!(
        few.cells
            .iter()
            .filter(|cell| cell.vertices[3] != INFINITE)
            .count(),
        49 * 49
    );
    let refused = Delaunay::triangulate(&lines(1100), &NoWatcher);
    assert!(matches!(
        refused,
        Err(DelaunayError::TooManyCells { vertices: 2200, .. })
    ));
}

struct CancelAfter(AtomicU32);

impl Watcher for CancelAfter {
    fn progress(&self, _: crate::base::progress::Stage, _: u64, _: u64) {}

    fn cancelled(&self) -> bool {
        self.0.fetch_sub(1, Ordering::Relaxed) <= 1
    }
}

#[test]
fn can_be_cancelled_anywhere() {
    let points = whole_points(20_000, 1 << 20, 7);
    for questions in [1, 2, 3, 20, 60] {
        let cancelled = Delaunay::triangulate(&points, &CancelAfter(AtomicU32::new(questions)));
        assert!(
            matches!(cancelled, Err(DelaunayError::Cancelled(_))),
            "after {questions} questions"
        );
    }
}

/// Points that once were handled wrongly, or are known to break such programs.
#[test]
fn past_failures() {
    let sets: &[&[[f64; 3]]] = &[
        // A cube and its centre: every vertex cospherical with seven others.
        &[
            [0., 0., 0.],
            [2., 0., 0.],
            [0., 2., 0.],
            [0., 0., 2.],
            [2., 2., 0.],
            [2., 0., 2.],
            [0., 2., 2.],
            [2., 2., 2.],
            [1., 1., 1.],
        ],
        // The first four points in one plane, the fifth beside it.
        &[
            [0., 0., 0.],
            [1., 0., 0.],
            [0., 1., 0.],
            [1., 1., 0.],
            [0.5, 0.5, 1.],
        ],
        // On a line up to one point, which makes slivers only.
        &[
            [0., 0., 0.],
            [1., 0., 0.],
            [2., 0., 0.],
            [3., 0., 0.],
            [1., 1e-6, 0.],
            [1., 0., 1e-6],
        ],
        // An octahedron about a point.
        &[
            [1., 0., 0.],
            [-1., 0., 0.],
            [0., 1., 0.],
            [0., -1., 0.],
            [0., 0., 1.],
            [0., 0., -1.],
            [0., 0., 0.],
        ],
        // Two points next to each other far from the rest.
        &[
            [0., 0., 0.],
            [1., 0., 0.],
            [0., 1., 0.],
            [0., 0., 1.],
            [1e6, 1e6, 1e6],
            [1e6, 1e6, 1000000.25],
        ],
    ];
    for set in sets {
        let points: Vec<_> = set.iter().copied().map(Point3::from).collect();
        assert_eq!(triangulated(&points).dimension, Dimension::Three);
    }
}

#[test]
fn validation_finds_what_is_wrong() {
    let sound = triangulated(&whole_points(50, 1000, 8));
    let broken = |change: &dyn Fn(&mut Delaunay)| {
        let mut delaunay = sound.clone();
        change(&mut delaunay);
        delaunay.validate().expect_err("a flaw")
    };
    let finite = sound
        .cells
        .iter()
        .position(|cell| cell.vertices[3] != INFINITE)
        .expect("finite cells");
    assert!(matches!(
        broken(&|d| d.cells[finite].vertices.swap(0, 1)),
        Flaw::Orientation { .. }
    ));
    assert!(matches!(
        broken(&|d| d.cells[finite].neighbours.swap(0, 1)),
        Flaw::Neighbour(_)
    ));
    assert!(matches!(
        broken(&|d| d.cells[finite].vertices[0] = 50),
        Flaw::Corners { .. }
    ));
    assert!(matches!(
        broken(&|d| d.sites.push(Site {
            x: 1,
            y: 1,
            z: 1,
            label: 0
        })),
        Flaw::Vertex { .. } | Flaw::Euler(_)
    ));
    let moved = broken(&|d| {
        let [a, b, c, e] = d.cells[finite]
            .vertices
            .map(|v| d.sites[v as usize].coordinates());
        let middle = |axis: usize| (a[axis] + b[axis] + c[axis] + e[axis]) / 4;
        let other = (0..50)
            .find(|v| !d.cells[finite].vertices.contains(v))
            .expect("more than four vertices");
        d.sites[other as usize] = Site {
            x: middle(0),
            y: middle(1),
            z: middle(2),
            label: 0,
        };
    });
    assert!(matches!(
        moved,
        Flaw::NotDelaunay(_) | Flaw::Orientation { .. }
    ));
}

/// Every ray reaches its target or the outside, leaves each cell through one of its own facets, and
/// goes forward.
#[test]
fn rays_reach_their_targets() {
    let mut cloud = whole_points(400, 1000, 9);
    cloud.extend(lattice(6).iter().map(|p| p * 200.0));
    let delaunay = triangulated(&cloud);
    let mut targets: Vec<_> = whole_points(20, 4000, 10)
        .iter()
        .map(|p| p - nalgebra::Vector3::repeat(1500.0))
        .collect();
    targets.extend(cloud.iter().step_by(7).copied());
    targets.push(Point3::new(1e12, -1e12, 3e12));
    for vertex in (0..delaunay.vertex_count() as u32).step_by(5) {
        let mut again = delaunay.ray(vertex);
        for target in &targets {
            let mut ray = ray_to(&delaunay, vertex, target);
            let crossings = check_ray(&delaunay, vertex, target, &mut ray);
            again.aim(target, delaunay.cell_of(vertex));
            assert_eq!(crossings, again.by_ref().collect::<Vec<_>>());
            assert_eq!((ray.cell(), ray.first()), (again.cell(), again.first()));
        }
    }
}

fn ray_to<'a>(delaunay: &'a Delaunay, vertex: u32, target: &Point3<f64>) -> Ray<'a> {
    let mut ray = delaunay.ray(vertex);
    ray.aim(target, delaunay.cell_of(vertex));
    ray
}

fn check_ray(
    delaunay: &Delaunay,
    vertex: u32,
    target: &Point3<f64>,
    ray: &mut Ray,
) -> Vec<Crossing> {
    let mut cell = ray.cell();
    assert!(delaunay.cells[cell as usize].vertices.contains(&vertex));
    let mut crossings = Vec::new();
    for crossing in ray.by_ref() {
        assert_eq!(crossing.facet.cell(), cell);
        assert!((0.0..1.0).contains(&crossing.t));
        assert!(
            crossings
                .last()
                .is_none_or(|last: &Crossing| last.t <= crossing.t)
        );
        let at = delaunay.position(vertex) + crossing.t * (target - delaunay.position(vertex));
        assert!(
            distance_outside(delaunay, cell, &at) < 1e-6 * (1.0 + at.coords.norm()),
            "{at} is not in cell {cell}"
        );
        cell = delaunay.neighbour(crossing.facet).cell();
        crossings.push(crossing);
    }
    assert_eq!(ray.cell(), cell);
    if !delaunay.is_infinite(cell) {
        assert!(distance_outside(delaunay, cell, target) < 1e-6 * (1.0 + target.coords.norm()));
    }
    crossings
}

/// Returns the distance of a point beyond the planes of a finite cell.
fn distance_outside(delaunay: &Delaunay, cell: u32, p: &Point3<f64>) -> f64 {
    (0..4)
        .map(|index| {
            let [a, b, c] = delaunay
                .facet_vertices(Facet::new(cell, index))
                .map(|v| delaunay.position(v));
            (b - a).cross(&(c - a)).normalize().dot(&(p - a))
        })
        .fold(f64::NEG_INFINITY, f64::max)
}

/// Against the obvious way: the cells that the segment meets are those that clipping it by their
/// planes leaves a piece in.
#[test]
fn rays_meet_the_cells_that_clipping_finds() {
    let delaunay = triangulated(&whole_points(150, 1 << 20, 11));
    for (vertex, target) in (0..150).step_by(10).zip(whole_points(15, 1 << 20, 12)) {
        let mut ray = ray_to(&delaunay, vertex, &target);
        let mut met = BTreeSet::from([ray.cell()]);
        met.extend(
            ray.by_ref()
                .map(|crossing| delaunay.neighbour(crossing.facet).cell()),
        );
        let clipped = (0..delaunay.cells.len() as u32).filter(|&cell| {
            !delaunay.is_infinite(cell) && clipped_length(&delaunay, cell, vertex, &target) > 1e-9
        });
        met.retain(|&cell| !delaunay.is_infinite(cell));
        assert_eq!(met, clipped.collect());
    }
}

fn clipped_length(delaunay: &Delaunay, cell: u32, vertex: u32, target: &Point3<f64>) -> f64 {
    let start = delaunay.position(vertex);
    let (mut from, mut to) = (0.0f64, 1.0f64);
    for index in 0..4 {
        let corners = delaunay.facet_vertices(Facet::new(cell, index));
        let [a, b, c] = corners.map(|v| delaunay.position(v));
        let normal = (b - a).cross(&(c - a)).normalize();
        let height = if corners.contains(&vertex) {
            0.0
        } else {
            normal.dot(&(start - a))
        };
        let slope = normal.dot(&(target - start));
        match slope.partial_cmp(&0.0) {
            Some(std::cmp::Ordering::Greater) => to = to.min(-height / slope),
            Some(std::cmp::Ordering::Less) => from = from.max(-height / slope),
            _ if height > 0.0 => return 0.0,
            _ => {}
        }
    }
    to - from
}

/// A ray along lattice lines and planes meets vertices, edges and facets all the way, and still
/// arrives.
#[test]
fn degenerate_rays_go_on() {
    let delaunay = triangulated(&lattice(7));
    let vertex_at =
        |x: u32, y: u32, z: u32| delaunay.vertex_of_point[(x + 7 * y + 49 * z) as usize];
    for target in [
        [6., 6., 6.],
        [6., 0., 0.],
        [6., 6., 0.],
        [6., 3., 0.],
        [6., 4., 2.],
        [3., 3., 3.],
        [0., 0., 6.],
        [60., 60., 60.],
    ] {
        let target = Point3::from(target);
        let mut ray = ray_to(&delaunay, vertex_at(0, 0, 0), &target);
        check_ray(&delaunay, vertex_at(0, 0, 0), &target, &mut ray);
    }
    let here = vertex_at(3, 3, 3);
    let mut ray = ray_to(&delaunay, here, &delaunay.position(here));
    assert_eq!(
        (ray.next(), delaunay.is_infinite(ray.cell())),
        (None, false)
    );
}

fn coordinate() -> impl Strategy<Value = i32> {
    prop_oneof![
        1 - HALF_RANGE..HALF_RANGE,
        -3..4,
        Just(HALF_RANGE - 1),
        Just(1 - HALF_RANGE)
    ]
}

fn site() -> impl Strategy<Value = Site> {
    (coordinate(), coordinate(), coordinate()).prop_map(|(x, y, z)| Site { x, y, z, label: 0 })
}

fn robustly(site: &Site) -> Coord3D<f64> {
    Coord3D {
        x: f64::from(site.x),
        y: f64::from(site.y),
        z: f64::from(site.z),
    }
}

fn sign(value: f64) -> i32 {
    if value == 0.0 {
        0
    } else {
        value.signum() as i32
    }
}

proptest! {
    /// `robust` has the opposite sense of orientation.
    #[test]
    fn orientation_agrees_with_robust(a in site(), b in site(), c in site(), d in site()) {
        prop_assert_eq!(orient(&a, &b, &c, &d), -sign(robust::orient3d(robustly(&a), robustly(&b), robustly(&c), robustly(&d))));
    }

    #[test]
    fn sphere_test_agrees_with_robust(a in site(), b in site(), c in site(), d in site(), p in site()) {
        let (b, c) = if orient(&a, &b, &c, &d) > 0 { (b, c) } else { (c, b) };
        prop_assume!(orient(&a, &b, &c, &d) > 0);
        let corners = [&a, &b, &c, &d];
        let expected = robust::insphere(robustly(&b), robustly(&a), robustly(&c), robustly(&d), robustly(&p));
        prop_assume!(expected != 0.0);
        prop_assert_eq!(in_sphere(corners, &p), expected > 0.0);
    }

    /// Perturbed answers fit together: of five cospherical points, the two tetrahedra on a triangle
    /// either both hold the other's apex or neither does.
    #[test]
    fn perturbation_is_symmetric(set in prop::sample::subsequence(whole_sphere(1241), 5).prop_shuffle()) {
        let sites: Vec<Site> = set.iter().map(|p| Site { x: p.x as i32, y: p.y as i32, z: p.z as i32, label: 0 }).collect();
        let [a, mut b, mut c, d, e] = [0, 1, 2, 3, 4].map(|i| &sites[i]);
        if orient(a, b, c, d) < 0 {
            (b, c) = (c, b);
        }
        prop_assume!(orient(a, b, c, d) > 0 && orient(a, c, b, e) > 0);
        prop_assert_eq!(in_sphere([a, b, c, d], e), in_sphere([a, c, b, e], d));
    }

    #[test]
    fn small_whole_sets_are_valid(set in prop::collection::vec((0..6, 0..6, 0..4), 0..60)) {
        let points: Vec<_> = set.iter().map(|&(x, y, z)| Point3::new(f64::from(x), f64::from(y), f64::from(z))).collect();
        triangulated(&points);
    }

    /// The result is a function of the set of points: the same cells, numbered the same, for any
    /// order.
    #[test]
    fn order_of_input_changes_nothing(
        set in prop::collection::vec((0..9, 0..9, 0..9), 5..80).prop_shuffle(),
        seed in any::<u64>(),
    ) {
        let points: Vec<_> = set.iter().map(|&(x, y, z)| Point3::new(f64::from(x), f64::from(y), f64::from(z))).collect();
        let mut shuffled = points.clone();
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        for i in (1..shuffled.len()).rev() {
            shuffled.swap(i, (random.next_u64() % (i as u64 + 1)) as usize);
        }
        let (one, other) = (triangulated(&points), triangulated(&shuffled));
        prop_assert_eq!(one.cells, other.cells);
        prop_assert_eq!(one.sites.len(), other.sites.len());
    }

    #[test]
    fn lines_in_sets_are_told(direction in (-9..9, -9..9, -9..9), steps in prop::collection::vec(0..1000, 3..20)) {
        let at = |s: i32| Site { x: direction.0 * s, y: direction.1 * s, z: direction.2 * s, label: 0 };
        prop_assert!(collinear(&at(steps[0]), &at(steps[1]), &at(steps[2])));
        let points: Vec<_> = steps.iter().map(|&s| {
            Point3::new(f64::from(direction.0 * s), f64::from(direction.1 * s), f64::from(direction.2 * s))
        }).collect();
        prop_assert!(matches!(triangulated(&points).dimension, Dimension::Zero | Dimension::One));
    }
}
