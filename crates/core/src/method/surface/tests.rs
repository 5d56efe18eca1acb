//! Whole surfaces from synthetic scenes with known shape, and degenerate input.

use nalgebra::{Matrix3, Point3, Rotation3, Vector2, Vector3};
use proptest::prelude::*;

use super::*;
use crate::{
    base::progress::NoWatcher,
    method::synthetic::Town,
    model::{
        camera::{Camera, CameraModel},
        georeference::UprightFrame,
        scene::{CameraIndex, PointIndex, Pose, View, ViewIndex},
        surface::{manifold::check_manifold, shapes},
    },
};

/// Points on a known surface, each with its outward normal, seen by pinhole cameras that look at
/// the origin.
struct Shape {
    points: Vec<(Point3<f64>, Vector3<f64>)>,
    centres: Vec<Point3<f64>>,
    /// Added to all coordinates.
    offset: Vector3<f64>,
}

impl Shape {
    /// Each view observes the points that face it by less than 75 degrees.
    fn scene(&self) -> Scene {
        let camera = Camera::new(
            1,
            CameraModel::Pinhole,
            2000,
            2000,
            vec![1000.0, 1000.0, 1000.0, 1000.0],
        )
        .unwrap();
        let mut scene = Scene {
            cameras: vec![camera],
            track_offsets: vec![0],
            ..Scene::default()
        };
        for (i, centre) in self.centres.iter().enumerate() {
            let up = if centre.x.hypot(centre.y) < 1e-9 {
                Vector3::y()
            } else {
                Vector3::z()
            };
            let rotation = Rotation3::face_towards(&-centre.coords, &-up).inverse();
            scene.views.push(View {
                name: format!("{i:03}.jpg"),
                image_id: i as u32,
                file_position: i as u32,
                camera: CameraIndex(0),
                cam_from_world: Pose {
                    rotation,
                    translation: -(rotation * (centre.coords + self.offset)),
                },
            });
        }
        for (i, (point, normal)) in self.points.iter().enumerate() {
            let world = point + self.offset;
            for v in 0..scene.views.len() as u32 {
                let towards = (self.centres[v as usize] - point).normalize();
                let x_cam = scene.views[v as usize]
                    .cam_from_world
                    .camera_from_world(&world);
                if normal.dot(&towards) > 0.26
                    && let Some(pixel) = scene.cameras[0].project(&x_cam)
                {
                    scene.track_views.push(ViewIndex(v));
                    scene.track_pixels.push([pixel.x, pixel.y]);
                }
            }
            scene.points.push(world);
            scene.point_ids.push(i as u64);
            scene.colours.push([0; 3]);
            scene.track_offsets.push(scene.track_views.len());
        }
        scene
    }
}

/// The two-dimensional R2 sequence: even and never regular.
fn even(i: usize) -> Vector2<f64> {
    Vector2::new(
        (0.754_877_666 * i as f64).fract(),
        (0.569_840_291 * i as f64).fract(),
    )
}

fn on_sphere(i: usize) -> Vector3<f64> {
    let e = even(i);
    let (z, angle) = (2.0 * e.x - 1.0, std::f64::consts::TAU * e.y);
    let r = (1.0 - z * z).sqrt();
    Vector3::new(r * angle.cos(), r * angle.sin(), z)
}

fn ball(count: usize) -> Shape {
    let points = (0..count)
        .map(|i| (Point3::from(on_sphere(i)), on_sphere(i)))
        .collect();
    let centres = (0..40).map(|i| Point3::from(on_sphere(i) * 4.0)).collect();
    Shape {
        points,
        centres,
        offset: Vector3::zeros(),
    }
}

/// A field of 6 x 6 with a block of 2 x 2 x 1 on it, flown over at height 5.
fn block() -> Shape {
    let mut points = Vec::new();
    for i in 0..4000 {
        let p = even(i) * 6.0 - Vector2::repeat(3.0);
        let height = if p.amax() < 1.0 { 1.0 } else { 0.0 };
        points.push((Point3::new(p.x, p.y, height), Vector3::z()));
    }
    for i in 0..1600 {
        let (e, side) = (even(i), i % 4);
        let wall = Rotation3::from_axis_angle(
            &Vector3::z_axis(),
            side as f64 * std::f64::consts::FRAC_PI_2,
        );
        points.push((
            wall * Point3::new(1.0, 2.0 * e.x - 1.0, e.y),
            wall * Vector3::x(),
        ));
    }
    let centres = (0..49)
        .map(|i| {
            Point3::new(
                f64::from(i % 7) * 2.0 - 6.0,
                f64::from(i / 7) * 2.0 - 6.0,
                5.0,
            )
        })
        .collect();
    Shape {
        points,
        centres,
        offset: Vector3::zeros(),
    }
}

fn settings(kind: SurfaceChoice) -> SurfaceSettings {
    SurfaceSettings {
        kind,
        ..SurfaceSettings::default()
    }
}

fn built(shape: &Shape, gsd: f64, kind: SurfaceChoice) -> (Surface, SurfaceStats) {
    build(
        &shape.scene(),
        &WantedGsd::uniform(gsd),
        &settings(kind),
        None,
        refine::MAX_TRIANGLES,
        &NoWatcher,
    )
    .unwrap()
}

#[test]
fn a_ball_seen_from_all_sides_is_closed() {
    for offset in [
        Vector3::zeros(),
        Vector3::new(400_000.0, 5_800_000.0, 300.0),
    ] {
        let (surface, stats) = built(
            &Shape {
                offset,
                ..ball(3000)
            },
            0.004,
            SurfaceChoice::Auto,
        );
        assert_eq!(surface.kind, SurfaceKind::Carved);
        assert_eq!(stats.points, 3000);
        let topology = check_manifold(&surface).unwrap();
        assert_eq!(
            (topology.euler, topology.border_edges, topology.components),
            (2, 0, 1)
        );
        let centred = Surface {
            vertices: surface.vertices.iter().map(|v| v - offset).collect(),
            ..surface
        };
        let share = shapes::volume(&centred) / (4.0 / 3.0 * std::f64::consts::PI);
        assert!((0.97..1.01).contains(&share), "{share}");
    }
}

#[test]
fn a_block_on_a_field_stands_upright() {
    let (surface, _) = built(&block(), 0.005, SurfaceChoice::Auto);
    assert_eq!(surface.kind, SurfaceKind::Carved);
    check_manifold(&surface).unwrap();
    // By area: roof and field face up, walls sideways, nothing down.
    let (mut up, mut side, mut down) = (0.0, 0.0, 0.0);
    for t in 0..surface.triangles.len() as u32 {
        let slope = surface.area_normal(t).normalize().z;
        *(if slope > 0.7 {
            &mut up
        } else if slope > -0.3 {
            &mut side
        } else {
            &mut down
        }) += surface.area(t);
    }
    assert!(
        (33.0..37.0).contains(&up) && (6.0..10.0).contains(&side) && down < 0.3,
        "{up} {side} {down}"
    );
}

#[test]
fn the_terrain_of_the_block_has_no_overhang() {
    let scene = block().scene();
    let frame = UprightFrame::new(&scene.points, &scene, None);
    let raw = terrain::triangulate(&scene.points, &frame, 0.1);
    assert!((0..raw.triangles.len() as u32).all(|t| raw.area_normal(t).z > 0.0));
    let (surface, _) = built(&block(), 0.005, SurfaceChoice::Terrain);
    assert_eq!(surface.kind, SurfaceKind::Terrain);
    for surface in [raw, surface] {
        let topology = check_manifold(&surface).unwrap();
        assert_eq!((topology.euler, topology.components), (1, 1));
    }
}

/// Tops of images that look down say nothing of what is up, and neither does the thinnest axis of a
/// narrow scene with relief.
#[test]
fn up_is_against_the_views_of_a_nadir_flight() {
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        400,
        300,
        vec![400.0, 400.0, 200.0, 150.0],
    )
    .unwrap();
    let mut scene = Town {
        tilt: None,
        ..Town::new(camera)
    }
    .scene();
    let corridor =
        |i: usize| Point3::new(100.0 * even(i).x, 12.0 * even(i).y, 14.0 * even(i * i).x);
    scene.points = (0..500).map(corridor).collect();
    let up = |scene: &Scene| UprightFrame::new(&scene.points, scene, None).up();
    assert!(up(&scene).z > 0.999, "{}", up(&scene));
    // Views along the corridor, as from a car, or upon it from the side, see its top at the top of
    // their images.
    for [right, ahead] in [[-Vector3::y(), Vector3::x()], [Vector3::x(), Vector3::y()]] {
        let rows = [right, -Vector3::z(), ahead].map(|axis| axis.transpose());
        let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_rows(&rows));
        scene
            .views
            .iter_mut()
            .for_each(|view| view.cam_from_world.rotation = rotation);
        assert!(up(&scene).z > 0.999, "{}", up(&scene));
    }
}

#[test]
fn one_thread_and_several_make_the_same_surface() {
    let shape = block();
    let with_threads = |n| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(n)
            .build()
            .unwrap();
        pool.install(|| built(&shape, 0.005, SurfaceChoice::Carved))
    };
    let ((a, _), (b, _)) = (with_threads(1), with_threads(5));
    assert_eq!((a.vertices, a.triangles), (b.vertices, b.triangles));
}

/// Flat points make a terrain whatever their slope; the triangles keep to the plane.
#[test]
fn a_plane_stays_a_plane() {
    let tilt = Rotation3::from_euler_angles(0.3, 0.4, 0.5);
    let mut shape = block();
    shape.points = (0..600)
        .map(|i| (even(i) * 4.0).push(0.0) - Vector3::new(2.0, 2.0, 0.0))
        .map(|p| (Point3::from(tilt * p), tilt * Vector3::z()))
        .collect();
    for kind in [SurfaceChoice::Auto, SurfaceChoice::Carved] {
        let (surface, _) = built(&shape, 0.01, kind);
        assert_eq!(surface.kind, SurfaceKind::Terrain);
        check_manifold(&surface).unwrap();
        assert!(
            surface
                .vertices
                .iter()
                .all(|v| (tilt.inverse() * v).z.abs() < 1e-9)
        );
        assert!(
            (10.0..=16.0).contains(&shapes::total_area(&surface)),
            "{}",
            shapes::total_area(&surface)
        );
    }
}

#[test]
fn few_points_and_lines_are_refused_with_a_cure() {
    let mut few = ball(3);
    few.points.extend(few.points.clone());
    let message = |shape: &Shape| {
        build(
            &shape.scene(),
            &WantedGsd::uniform(0.01),
            &settings(SurfaceChoice::Auto),
            None,
            refine::MAX_TRIANGLES,
            &NoWatcher,
        )
        .unwrap_err()
        .to_string()
    };
    assert!(
        message(&few).starts_with("only 3 different sparse points"),
        "{}",
        message(&few)
    );
    assert!(message(&ball(0)).starts_with("only 0 different"));
    let mut line = ball(0);
    line.points = (0..200)
        .map(|i| {
            (
                Point3::from(Vector3::new(0.3, 0.1, 0.7) * f64::from(i) / 200.0),
                Vector3::x(),
            )
        })
        .collect();
    assert!(message(&line).contains("on one line"), "{}", message(&line));
}

#[test]
fn nine_of_ten_points_may_be_repeated() {
    let mut shape = block();
    shape.points = (0..10).flat_map(|_| shape.points.clone()).collect();
    let (surface, stats) = built(&shape, 0.005, SurfaceChoice::Auto);
    assert_eq!(stats.vertices, 5600);
    check_manifold(&surface).unwrap();
}

#[test]
fn points_that_do_not_fit_their_views_are_left_out() {
    let mut scene = ball(500).scene();
    let track = scene.track(PointIndex(7));
    scene.track_pixels[track]
        .iter_mut()
        .for_each(|p| p[0] += 30.0);
    let track = scene.track(PointIndex(9));
    let first = scene.track_views[track.start];
    scene.track_views[track].fill(first);
    let usable = points::usable_points(&scene);
    assert_eq!(usable.len(), 498);
    assert!(!usable.contains(&PointIndex(7)) && !usable.contains(&PointIndex(9)));
}

#[test]
fn a_point_out_of_all_proportion_is_left_out() {
    let mut scene = ball(500).scene();
    let all: Vec<PointIndex> = (0..500).map(PointIndex).collect();
    assert_eq!(points::near(&scene, all.clone()), all);
    scene.points[11] = Point3::new(1e9, 0.0, 0.0);
    let left = points::near(&scene, all);
    assert!(left.len() == 499 && !left.contains(&PointIndex(11)));
}

#[test]
fn a_given_mesh_is_simplified_refined_or_left() {
    let scene = ball(10).scene();
    let from = |mesh_as_is| {
        let Surface {
            vertices,
            triangles,
            ..
        } = shapes::sphere(5);
        build(
            &scene,
            &WantedGsd::uniform(0.01),
            &SurfaceSettings {
                mesh_as_is,
                ..SurfaceSettings::default()
            },
            Some(Mesh {
                vertices,
                triangles,
            }),
            refine::MAX_TRIANGLES,
            &NoWatcher,
        )
    };
    let (whole, _) = from(true).unwrap();
    assert_eq!(
        (whole.kind, whole.triangles),
        (SurfaceKind::Mesh, shapes::sphere(5).triangles)
    );
    let (simple, stats) = from(false).unwrap();
    assert!(simple.triangles.len() < 1000 && stats.raw_triangles == 0);
    assert_eq!(check_manifold(&simple).map(|t| t.euler), Ok(2));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(500))]

    /// Points on a coarse lattice: repeated, collinear, coplanar, cospherical. A manifold or a
    /// clear error, never a panic.
    #[test]
    fn degenerate_points_end_in_a_manifold_or_an_error(
        lattice in prop::collection::vec((0u8..4, 0u8..4, 0u8..3), 0..200), scale in -3i32..6, carved: bool,
    ) {
        let scale = 10f64.powi(scale);
        let mut shape = ball(0);
        shape.centres.iter_mut().for_each(|c| *c *= 3.0 * scale);
        shape.points = lattice
            .iter()
            .map(|&(x, y, z)| (Point3::new(f64::from(x), f64::from(y), f64::from(z)) * scale, Vector3::z()))
            .collect();
        let kind = if carved { SurfaceChoice::Carved } else { SurfaceChoice::Auto };
        if let Ok((surface, _)) = build(&shape.scene(), &WantedGsd::uniform(0.02 * scale), &settings(kind), None, refine::MAX_TRIANGLES, &NoWatcher) {
            check_manifold(&surface).map_err(|e| TestCaseError::fail(e.to_string()))?;
        }
    }
}

/// Converters write meshes whose triangles face anywhere, or of which some are lost.
#[test]
fn a_mesh_may_face_anywhere_and_have_gaps() {
    let corner = |x: u32, y: u32| 21 * y + x;
    let vertices: Vec<_> = (0..21 * 21)
        .map(|v| Point3::new(f64::from(v % 21), f64::from(v / 21), 0.0))
        .collect();
    let squares = (0..20).flat_map(|y| (0..20).map(move |x| (x, y)));
    let triangles: Vec<[u32; 3]> = squares
        .flat_map(|(x, y)| {
            let [a, b, c, d] = [
                corner(x, y),
                corner(x + 1, y),
                corner(x + 1, y + 1),
                corner(x, y + 1),
            ];
            [[a, b, c], [a, c, d]]
        })
        .collect();
    let flipped = triangles.iter().enumerate();
    let flipped = flipped.map(|(n, &[a, b, c])| if n % 2 == 0 { [a, b, c] } else { [a, c, b] });
    for triangles in [
        flipped.collect(),
        triangles.iter().copied().step_by(2).collect::<Vec<_>>(),
    ] {
        let surface = build(
            &Scene::default(),
            &WantedGsd::uniform(0.1),
            &SurfaceSettings {
                mesh_as_is: true,
                ..SurfaceSettings::default()
            },
            Some(Mesh {
                vertices: vertices.clone(),
                triangles,
            }),
            refine::MAX_TRIANGLES,
            &NoWatcher,
        );
        assert!(surface.is_ok(), "{surface:?}");
    }
}
