use nalgebra::{Matrix3, Rotation3};

use super::*;
use crate::{
    base::{progress::NoWatcher, rows::Offsets},
    method::region::{Area, Areas, Coordinates},
    model::{
        camera::{Camera, CameraModel},
        georeference::Georeference,
        scene::{CameraIndex, Pose, View},
        surface::SurfaceKind,
    },
};

/// Two photographs from a height of 10, each of 10 by 10 units of the ground, at x = 0 and 5, and
/// points on level ground.
fn flight() -> Scene {
    let down = Rotation3::from_matrix_unchecked(Matrix3::new(
        1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0,
    ));
    let view = |(n, x): (u32, f64)| View {
        name: format!("{n}.jpg"),
        image_id: n,
        file_position: n,
        camera: CameraIndex(0),
        cam_from_world: Pose {
            rotation: down,
            translation: -(down * Vector3::new(x, 0.0, 10.0)),
        },
    };
    let params = vec![100.0, 100.0, 50.0, 50.0];
    let point = |i: i32| Point3::new(f64::from(i % 7), f64::from(i / 7) - 3.0, 0.0);
    Scene {
        cameras: vec![Camera::new(1, CameraModel::Pinhole, 100, 100, params).unwrap()],
        views: [(0, 0.0), (1, 5.0)].map(view).into(),
        points: (0..49).map(point).collect(),
        ..Scene::default()
    }
}

fn rectangle(low: [f64; 2], high: [f64; 2]) -> Footprint<'static> {
    let corner = |x: usize, y: usize| Point3::new([low, high][x][0], [low, high][y][1], 3.0);
    Footprint::Hull(
        [(0, 0), (1, 0), (1, 1), (0, 1)]
            .map(|(x, y)| corner(x, y))
            .into(),
    )
}

fn photographed<'a>(scene: &'a Scene, left_out: &'a [ViewIndex]) -> Photographed<'a> {
    Photographed {
        scene,
        left_out,
        gsd: 0.1,
        image_scale: 1.0,
        surface: None,
    }
}

#[test]
fn photographs_are_counted_all_over_the_region() {
    let scene = flight();
    let frame = MapFrame::new(&scene, Some([0.0, 0.0, 1.0]));
    let region = rectangle([-5.0, -5.0], [25.0, 5.0]);
    let ground = Ground::new(&region, &photographed(&scene, &[]), &frame, &NoWatcher)
        .unwrap()
        .unwrap();
    assert!((ground.area - 300.0).abs() < 1e-9, "{}", ground.area);
    let share = |views: u32| ground.share(|cell| cell.views == views);
    let expected = [1.0 / 2.0, 1.0 / 3.0, 1.0 / 6.0];
    for (views, expected) in (0..).zip(expected) {
        assert!(
            (share(views) - expected).abs() < 0.02,
            "{views}: {}",
            share(views)
        );
    }
    assert_eq!(ground.share(|cell| cell.has_surface), 0.0);
    let first_only = Ground::new(
        &region,
        &photographed(&scene, &[ViewIndex(1)]),
        &frame,
        &NoWatcher,
    )
    .unwrap()
    .unwrap();
    assert!((first_only.share(|cell| cell.views == 0) - 2.0 / 3.0).abs() < 0.02);
}

#[test]
fn a_place_seen_too_coarsely_is_not_photographed_but_told_from_one_that_is_not_seen() {
    let scene = flight();
    let frame = MapFrame::new(&scene, Some([0.0, 0.0, 1.0]));
    let region = rectangle([-5.0, -5.0], [15.0, 5.0]);
    let wanted = |gsd| {
        let photographed = Photographed {
            gsd,
            ..photographed(&scene, &[])
        };
        let ground = Ground::new(&region, &photographed, &frame, &NoWatcher)
            .unwrap()
            .unwrap();
        [0, 1].map(|beyond| {
            let place = [12.0 * f64::from(beyond), 0.0];
            let cell = ground.cells.iter().min_by(|a, b| {
                let off = |cell: &GroundCell| (cell.place[0] - place[0]).abs();
                off(a).total_cmp(&off(b))
            });
            cell.map(|cell| (cell.views == 0, cell.too_coarse)).unwrap()
        })
    };
    let beyond = (true, false);
    assert_eq!(wanted(0.1 / COARSEST * 1.01), [(false, false), beyond]);
    assert_eq!(wanted(0.1 / COARSEST * 0.99), [(true, true), beyond]);
}

#[test]
fn an_area_of_the_region_may_want_more_than_the_rest() {
    let scene = flight();
    let frame = MapFrame::new(&scene, Some([0.0, 0.0, 1.0]));
    let square = |x: f64, gsd: Option<f64>| Area {
        polygons: vec![vec![vec![
            [x, -5.0],
            [x + 5.0, -5.0],
            [x + 5.0, 5.0],
            [x, 5.0],
        ]]],
        weight: 1.0,
        gsd,
    };
    let finer = 0.1 / COARSEST * 0.99;
    let areas = Areas {
        coordinates: Coordinates::Model {
            axes: Some([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        },
        areas: vec![square(-5.0, None), square(0.0, Some(finer))],
    };
    let areas = MapAreas::new(areas, &Georeference::Local, &frame).unwrap();
    let region = Footprint::Areas(&areas);
    let ground = Ground::new(&region, &photographed(&scene, &[]), &frame, &NoWatcher)
        .unwrap()
        .unwrap();
    for cell in &ground.cells {
        let x = ground.plane.at(cell.place).x;
        let wanted = if x < 0.0 { 0.1 } else { finer };
        assert_eq!((cell.gsd, cell.too_coarse), (wanted, x > 0.0), "{x}");
    }
}

#[test]
fn the_area_is_that_of_the_polygons_but_what_lies_in_two_counts_once() {
    let scene = flight();
    let frame = MapFrame::new(&scene, Some([0.0, 0.0, 1.0]));
    let area = |polygons: Vec<Vec<Vec<[f64; 2]>>>| {
        let areas = Areas {
            coordinates: Coordinates::Model {
                axes: Some([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
            },
            areas: vec![Area {
                polygons,
                weight: 1.0,
                gsd: None,
            }],
        };
        let areas = MapAreas::new(areas, &Georeference::Local, &frame).unwrap();
        let region = Footprint::Areas(&areas);
        let ground = Ground::new(&region, &photographed(&scene, &[]), &frame, &NoWatcher);
        ground.unwrap().unwrap().area
    };
    let diamond = |x: f64, half: f64| vec![[x - half, 0.], [x, -half], [x + half, 0.], [x, half]];
    let with_hole = vec![diamond(0.0, 4.0), diamond(0.0, 1.0)];
    let apart = vec![diamond(9.0, 2.0)];
    let exact = area(vec![with_hole, apart]);
    assert!((exact - (32.0 - 2.0 + 8.0)).abs() < 1e-9, "{exact}");
    let twice = area(vec![vec![diamond(0.0, 4.0)], vec![diamond(0.0, 4.0)]]);
    assert!((twice - 32.0).abs() < 0.5, "{twice}");
}

#[test]
fn the_surface_counts_where_a_view_shows_it() {
    let scene = flight();
    let frame = MapFrame::new(&scene, Some([0.0, 0.0, 1.0]));
    let corners = [[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0]];
    let surface = Surface {
        kind: SurfaceKind::Terrain,
        vertices: corners.map(|[x, y]| Point3::new(x, y, 1.0)).into(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
    };
    let photographed = Photographed {
        surface: Some((
            &surface,
            &[Photographs { fine: 7, coarse: 1 }, Photographs::default()],
        )),
        ..photographed(&scene, &[])
    };
    let region = rectangle([-5.0, -5.0], [5.0, 5.0]);
    let ground = Ground::new(&region, &photographed, &frame, &NoWatcher)
        .unwrap()
        .unwrap();
    assert!((ground.share(|cell| cell.has_surface) - 0.5).abs() < 0.02);
    let below = |cell: &&GroundCell| {
        let world = ground.plane.at(cell.place);
        world.x > world.y + 0.2
    };
    assert!(
        ground
            .cells
            .iter()
            .filter(below)
            .all(|cell| cell.views == 7)
    );
}

#[test]
fn views_too_far_from_the_surface_show_it_too_coarsely() {
    let scene = flight();
    let frame = MapFrame::new(&scene, Some([0.0, 0.0, 1.0]));
    let corners = [[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0]];
    let surface = Surface {
        kind: SurfaceKind::Terrain,
        vertices: corners.map(|[x, y]| Point3::new(x, y, 0.0)).into(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
    };
    let visibility = Visibility {
        offsets: Offsets::from_lengths([2, 1]),
        triangles: vec![0, 1, 1].into(),
        contradictions: 0,
    };
    // Both cameras are 10 above the ground, where a pixel of theirs is 0.1.
    let of = |gsd, left_out, wishes: &[f32]| {
        let bare = Photographed {
            gsd,
            ..photographed(&scene, left_out)
        };
        bare.of_triangles(&surface, &visibility, wishes, &NoWatcher)
            .unwrap()
            .into_iter()
            .map(|Photographs { fine, coarse }| [fine, coarse])
            .collect::<Vec<_>>()
    };
    let [enough, too_fine] = [1.01, 0.99].map(|share| share * 0.1 / COARSEST);
    assert_eq!(of(enough, &[], &[]), [[1, 0], [2, 0]]);
    assert_eq!(of(too_fine, &[], &[]), [[0, 1], [0, 2]]);
    assert_eq!(of(0.1, &[ViewIndex(0)], &[]), [[0, 0], [1, 0]]);
    // The second is in an area that wants more of it.
    let wishes = [f32::INFINITY, too_fine as f32];
    assert_eq!(of(enough, &[], &wishes), [[1, 0], [0, 2]]);
    let photographed = Photographed {
        surface: Some((&surface, &[Photographs { fine: 0, coarse: 2 }; 2])),
        ..photographed(&scene, &[])
    };
    let region = rectangle([-5.0, -5.0], [5.0, 5.0]);
    let ground = Ground::new(&region, &photographed, &frame, &NoWatcher)
        .unwrap()
        .unwrap();
    let is_so = |cell: &GroundCell| cell.views == 0 && cell.too_coarse && cell.has_surface;
    assert_eq!(ground.share(is_so), 1.0);
}

#[test]
fn a_plane_follows_the_slope_and_not_the_outliers() {
    let frame = MapFrame {
        origin: Point3::new(1.0, 2.0, 3.0),
        axes: [Vector3::x(), Vector3::y(), Vector3::z()],
    };
    let slope = |x: f64, y: f64| Point3::new(x, y, 5.0 + 0.1 * x - 0.3 * y);
    let mut points: Vec<Point3<f64>> = (0..400)
        .map(|i| slope(f64::from(i % 20), f64::from(i / 20)))
        .collect();
    points.extend((0..20).map(|i| Point3::new(f64::from(i), 3.0, 900.0)));
    let plane = GroundPlane::new(&frame, &points).unwrap();
    for [x, y] in [[0.0, 0.0], [15.0, -40.0]] {
        let expected = slope(x + 1.0, y + 2.0);
        assert!((plane.at([x, y]) - expected).norm() < 1e-6);
    }
    assert!(GroundPlane::new(&frame, &[]).is_none());
    let one = GroundPlane::new(&frame, &points[..1]).unwrap();
    assert_eq!(one.at([3.0, 3.0]).z, points[0].z);
}

#[test]
fn a_position_is_found_on_the_map_by_what_projects_to_it() {
    let scene = flight();
    let frame = MapFrame::new(&scene, Some([0.0, 0.0, 1.0]));
    let plane = GroundPlane::new(&frame, &scene.points).unwrap();
    // As of longitudes, whose meridians converge.
    let project = |p: &Point3<f64>| [21.0 + 1e-5 * p.x * (1.0 + 1e-4 * p.y), 52.0 + 9e-6 * p.y];
    for wanted in [[3.0, 2.0], [-80.0, 60.0]] {
        let found = plane.invert(project(&plane.at(wanted)), project).unwrap();
        let off = (found[0] - wanted[0]).hypot(found[1] - wanted[1]);
        assert!(off < 1e-6, "{found:?}");
    }
    assert_eq!(plane.invert([f64::NAN, 0.0], project), None);
}
