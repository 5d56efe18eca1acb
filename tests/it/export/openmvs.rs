//! OpenMVS: scenes per cluster, the joint scene for OpenDroneMap, and lists of neighbours for a
//! scene that is there.

use nalgebra::{Matrix3, Vector3};
use viewrank::backends::{BackendError, ExportOptions};
use viewrank_core::{base::error::Hint, model::scene::ViewIndex};
use viewrank_io::formats::openmvs::{Mvs, Vertex, VertexView};

use super::{Files, Fixture};

fn cluster(files: &Files, rank: usize) -> Mvs {
    Mvs::read(files.bytes(&format!("clusters/{rank:04}.mvs"))).unwrap()
}

fn names(mvs: &Mvs) -> Vec<String> {
    mvs.images
        .iter()
        .map(|i| String::from_utf8(i.name.clone()).unwrap())
        .collect()
}

/// Images that OpenMVS would compute: two neighbours by shared vertices (one where there are but
/// two images), unless a score below `View Min Score` (0 in dense.cfg, 2 without it) is given.
fn computed(mvs: &Mvs, least_score: f32) -> Vec<usize> {
    let wanted = 2.min(mvs.images.len() - 1);
    let is = |&i: &usize| {
        if let Some(first) = mvs.images[i].view_scores.first() {
            return first.score >= least_score;
        }
        let others = (0..mvs.images.len()).filter(|&o| o != i);
        let shared = |o: usize| {
            let sees = |v: &&Vertex, i: usize| v.views.iter().any(|s| s.image as usize == i);
            mvs.vertices
                .iter()
                .filter(|v| sees(v, i) && sees(v, o))
                .count()
        };
        others.filter(|&o| shared(o) >= 3).count() >= wanted
    };
    (0..mvs.images.len()).filter(is).collect()
}

#[test]
fn only_the_key_view_of_a_cluster_is_computed_with_all_its_partners() {
    for k in [1, 2, 5, 14] {
        let fixture = Fixture::new(k);
        let files = fixture.export("openmvs");
        for (i, (key, partners)) in fixture.named().iter().enumerate() {
            let mvs = cluster(&files, i + 1);
            let wanted: Vec<String> = std::iter::once(key)
                .chain(partners)
                .map(|n| format!("../../images/{n}"))
                .collect();
            assert_eq!(names(&mvs), wanted, "a map is made in unfinished/0001");
            assert_eq!(computed(&mvs, 0.0), [0], "k = {k}");
            for partner in 1..=k as u32 {
                let shared = mvs
                    .vertices
                    .iter()
                    .filter(|v| v.views.iter().any(|s| s.image == partner))
                    .count();
                assert!(
                    shared > 3,
                    "a neighbour needs three shared points, the key view more than three"
                );
            }
        }
    }
}

#[test]
fn openmvs_all_images_loaded() {
    let files = Fixture::new(4).export("openmvs");
    assert_eq!(cluster(&files, 1).images.len(), 5);
    assert_eq!(
        Mvs::read(files.bytes("fuse.mvs")).unwrap().images.len(),
        4,
        "key views only"
    );
}

#[test]
fn openmvs_single_view_vertex() {
    let files = Fixture::new(4).export("openmvs");
    let two = |v: &Vertex| v.views.len() == 2 && v.views[0].image < v.views[1].image;
    assert!((1..=4).all(|rank| cluster(&files, rank).vertices.iter().all(two)));
}

#[test]
fn openmvs_dummy_entry_must_exist() {
    let mvs = cluster(&Fixture::new(1).export("openmvs"), 1);
    assert_eq!(mvs.images[1].view_scores.len(), 1);
    assert!(mvs.images[1].view_scores[0].index < 2 && mvs.images[1].view_scores[0].score < 0.0);
}

#[test]
fn openmvs_version_too_new() {
    assert_eq!(
        cluster(&Fixture::new(2).export("openmvs"), 1).version,
        6,
        "readable by v2.0 and later"
    );
    assert_eq!(
        cluster(&Fixture::new(1).export("openmvs"), 1).version,
        7,
        "scores exist in 7 only"
    );
}

#[test]
fn openmvs_pixel_centre() {
    let files = Fixture::new(3).export("openmvs");
    let camera = &cluster(&files, 1).platforms[0].cameras[0];
    assert_eq!(
        camera.k,
        [510.0, 0.0, 329.75, 0.0, 500.0, 229.0, 0.0, 0.0, 1.0]
    );
    assert_eq!(
        (camera.width, camera.height, files.0.record.pixel_shift),
        (640, 480, -0.5)
    );
}

#[test]
fn a_vertex_projects_to_where_it_was_measured() {
    let fixture = Fixture::new(3);
    let mvs = cluster(&fixture.export("openmvs"), 1);
    let (camera, pose) = (&mvs.platforms[0].cameras[0], &mvs.platforms[0].poses[0]);
    let view = fixture.scene.view(fixture.clusters[0].key);
    for vertex in &mvs.vertices {
        let x = Vector3::from(vertex.x.map(f64::from));
        let pixel = Matrix3::from_row_slice(&camera.k)
            * (Matrix3::from_row_slice(&pose.r) * (x - Vector3::from(pose.c)));
        let expected = fixture
            .scene
            .camera_of(fixture.clusters[0].key)
            .project(&view.cam_from_world.camera_from_world(&x.into()))
            .unwrap();
        assert!(
            (pixel.x / pixel.z + 0.5 - expected.x).abs() < 1e-6
                && (pixel.y / pixel.z + 0.5 - expected.y).abs() < 1e-6
        );
    }
}

const FAR: Vector3<f64> = Vector3::new(431_234.0, 5_412_345.0, 210.0);

fn far_away() -> Fixture {
    let mut fixture = Fixture::new(3);
    fixture.scene = fixture.scene.moved(-FAR);
    fixture
}

/// Of those that count in 32 bits each shifts, and says so; but ODM wants its own coordinates, and
/// a workspace in place is COLMAP's.
#[test]
fn no_backend_loses_map_coordinates_silently() {
    let (near, far) = (Fixture::new(3), far_away());
    for backend in [
        "openmvs",
        "colmap",
        "splat",
        "mvsnet",
        "patchmatchnet",
        "acmm",
        "gipuma",
        "pmvs",
        "mve",
        "alicevision",
    ] {
        let record = far.export(backend).0.record;
        let origin = Vector3::from(record.origin);
        assert!((origin - FAR).norm() < 200.0, "{backend}: {origin}");
        assert!(
            record
                .warnings
                .iter()
                .any(|w| w.contains("counts in 32 bits")),
            "{backend}"
        );
        let record = near.export(backend).0.record;
        assert!(
            record.origin == [0.0; 3] && !record.warnings.iter().any(|w| w.contains("32 bits")),
            "{backend}"
        );
    }
    assert!(far.export("odm").says("rounded to 0.65 units"));
    let mut in_place = far_away();
    in_place.project.dense_workspace = Some("/nowhere".into());
    assert!(in_place.export("colmap").says("rounded to 0.65 units"));
}

/// What each writes of a camera leads to its place, once the origin is added.
#[test]
fn shifted_cameras_are_where_they_were() {
    let fixture = far_away();
    let view = fixture.clusters[0].key;
    let centre = fixture.scene.view(view).cam_from_world.centre().coords;
    let numbers = |text: &str| {
        text.split_whitespace()
            .map(|w| w.parse().unwrap())
            .collect::<Vec<f64>>()
    };
    let near = |files: &Files, found: Vector3<f64>| {
        let off = (found + Vector3::from(files.0.record.origin) - centre).norm();
        assert!(off < 1e-6, "{}: {off}", files.0.record.backend);
    };
    let files = fixture.export("mvsnet");
    let cam: Vec<f64> = super::mvsnet::first_camera(&files)
        .lines()
        .skip(1)
        .take(3)
        .flat_map(numbers)
        .collect();
    let p = nalgebra::Matrix3x4::from_row_slice(&cam);
    near(
        &files,
        -(p.fixed_view::<3, 3>(0, 0).transpose() * p.column(3)),
    );
    let files = fixture.export("gipuma");
    let key = &files.0.record.clusters[0].key.target;
    let p = nalgebra::Matrix3x4::from_row_slice(&numbers(files.text(&format!("p/{key}.P"))));
    near(
        &files,
        -(p.fixed_view::<3, 3>(0, 0).try_inverse().unwrap() * p.column(3)),
    );
    for (backend, folder) in [("colmap", "sparse"), ("splat", "sparse/0")] {
        let files = fixture.export(backend);
        let file = |stem: &str| files.bytes(&format!("{folder}/{stem}.bin"));
        let bytes = viewrank_io::formats::Bytes {
            cameras: file("cameras"),
            images: file("images"),
            points3d: file("points3D"),
            ..Default::default()
        };
        let scene = viewrank_io::formats::colmap_bin::read(&bytes)
            .unwrap()
            .scene()
            .unwrap();
        let found = scene.find(fixture.name(view)).unwrap();
        near(&files, scene.view(found).cam_from_world.centre().coords);
        assert!(scene.points.iter().all(|x| x.coords.norm() < 2000.0));
    }
}

#[test]
fn map_coordinates_get_an_origin_of_their_own() {
    let fixture = far_away();
    let far = FAR;
    let files = fixture.export("openmvs");
    let origin = Vector3::from(files.0.record.origin);
    assert!((origin - far).norm() < 100.0 && origin.iter().all(|x| x.fract() == 0.0));
    let mvs = cluster(&files, 1);
    let x = Vector3::from(mvs.vertices[0].x.map(f64::from)) + origin;
    let nearest = fixture
        .scene
        .points
        .iter()
        .map(|p| (p.coords - x).norm())
        .fold(f64::MAX, f64::min);
    assert!(
        nearest < 1e-4,
        "{nearest}: without it f32 would be off by up to 0.25"
    );
}

#[test]
fn openmvs_seed_dmap_size() {
    let files = Fixture::new(3).export("openmvs");
    assert!(
        !files.names().iter().any(|n| n.ends_with(".dmap")),
        "no seeds: none can have the wrong size"
    );
}

#[test]
fn openmvs_seed_for_every_key() {
    let files = Fixture::new(3).export("openmvs");
    let with_points = (1..=4)
        .filter(|&rank| !cluster(&files, rank).vertices.is_empty())
        .count();
    assert_eq!(
        with_points, 4,
        "each key view's range comes from its points, none from a seed"
    );
}

#[test]
fn openmvs_viewscore_below_minimum() {
    let files = Fixture::new(3).export("openmvs");
    assert!(
        files
            .text("dense.cfg")
            .contains("View Min Score = 0\nView Min Score Ratio = 0\n"),
        "no partner is dropped by its score"
    );
}

#[test]
fn openmvs_number_views_cuts_partners() {
    let files = Fixture::new(14).export("openmvs");
    let limit: usize = files
        .lines("dense.cfg")
        .iter()
        .find_map(|l| l.strip_prefix("Max Views = "))
        .unwrap()
        .parse()
        .unwrap();
    assert!(
        limit * 3 / 4 >= 14,
        "above three quarters of the limit OpenMVS filters by angle and scale"
    );
    let options = &files.json("run.json")["options"];
    let words: Vec<&str> = options
        .as_array()
        .unwrap()
        .iter()
        .map(|word| word.as_str().unwrap())
        .collect();
    assert!(words.windows(2).any(|pair| pair == ["--number-views", "0"]));
}

#[test]
fn openmvs_interfacecolmap_drops_partners() {
    let files = Fixture::new(3).export("openmvs");
    assert!(
        !files.text("run.py").contains("InterfaceCOLMAP")
            && files.0.record.commands == ["python3 -I run.py"]
    );
}

#[test]
fn openmvs_fuse_needs_key_partners() {
    let mut fixture = Fixture::new(3);
    let neighbours: Vec<u32> = fixture
        .connected(ViewIndex(12))
        .iter()
        .take(3)
        .map(|v| v.0)
        .collect();
    fixture.choose(&[12, neighbours[0], neighbours[1], 49], 3);
    let run = fixture.export("openmvs").json("run.json");
    let overlaps = run["overlaps"].as_array().unwrap();
    assert_eq!(overlaps.len(), 4);
    for (i, list) in overlaps.iter().enumerate() {
        let list: Vec<usize> = list
            .as_array()
            .unwrap()
            .iter()
            .map(|v| v.as_u64().unwrap() as usize)
            .collect();
        assert!(
            !list.is_empty() && list.iter().all(|&o| o < 4 && o != i),
            "other key views, whatever the partners were"
        );
    }
    assert!(overlaps[0].as_array().unwrap().contains(&1.into()));
}

#[test]
fn a_single_key_view_has_a_scene_to_be_fused_in() {
    let mut fixture = Fixture::new(3);
    fixture.choose(&[12], 3);
    let files = fixture.export("openmvs");
    assert_eq!(Mvs::read(files.bytes("fuse.mvs")).unwrap().images.len(), 2);
    assert_eq!(
        files.json("run.json")["overlaps"],
        serde_json::json!([[1], []])
    );
}

/// A scene of all views, in the order of the file, under other folders, with ids that are no
/// positions.
fn existing_scene(fixture: &Fixture, scale: f64) -> Mvs {
    let mut all = Fixture::new(1);
    all.scene = fixture.scene.clone();
    let mut order: Vec<ViewIndex> = all.scene.view_indices().collect();
    order.sort_by_key(|&v| all.scene.view(v).file_position);
    all.choose(&order.iter().map(|v| v.0).collect::<Vec<_>>(), 1);
    let mut mvs = Mvs::read(all.export("odm").bytes("openmvs/scene.mvs")).unwrap();
    // An only partner is in ODM's scene once more.
    mvs.images.truncate(order.len());
    mvs.vertices
        .retain(|v| v.views.iter().all(|s| (s.image as usize) < order.len()));
    for image in &mut mvs.images {
        image.name = [b"undistorted/", &image.name["../images/".len()..]].concat();
        image.view_scores.clear();
    }
    mvs.platforms[0]
        .poses
        .iter_mut()
        .for_each(|p| p.c = p.c.map(|c| c * scale));
    mvs.vertices
        .iter_mut()
        .for_each(|v| v.x = v.x.map(|x| x * scale as f32));
    mvs
}

struct Neighbours {
    fixture: Fixture,
    mvs: Mvs,
    folder: tempfile::TempDir,
}

impl Neighbours {
    fn new(scale: f64) -> Self {
        let fixture = Fixture::new(3);
        let mvs = existing_scene(&fixture, scale);
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("scene.mvs"), mvs.write()).unwrap();
        Self {
            fixture,
            mvs,
            folder,
        }
    }

    fn export(&self, scale: bool) -> Result<Files, BackendError> {
        let scene = Some(self.folder.path().join("scene.mvs"));
        self.fixture
            .try_export(
                "openmvs",
                &ExportOptions {
                    scene,
                    scale,
                    ..Default::default()
                },
            )
            .map(Files)
    }
}

#[test]
fn openmvs_index_not_id() {
    let it = Neighbours::new(1.0);
    let files = it.export(false).unwrap();
    for (line, (key, partners)) in files.lines("neighbours.txt").iter().zip(it.fixture.named()) {
        let named = |word: &str| {
            String::from_utf8(it.mvs.images[word.parse::<usize>().unwrap()].name.clone()).unwrap()
        };
        let written: Vec<String> = line.split(' ').map(named).collect();
        let wanted: Vec<String> = std::iter::once(key)
            .chain(partners)
            .map(|n| format!("undistorted/{n}"))
            .collect();
        assert_eq!(written, wanted, "positions in that scene, found by name");
    }
}

#[test]
fn openmvs_duplicate_neighbour_line() {
    let files = Neighbours::new(1.0).export(false).unwrap();
    let mut keys: Vec<&str> = files
        .lines("neighbours.txt")
        .iter()
        .map(|l| l.split(' ').next().unwrap())
        .collect();
    keys.sort_unstable();
    keys.dedup();
    assert_eq!(keys.len(), 4);
}

#[test]
fn openmvs_empty_line_is_auto() {
    let files = Neighbours::new(1.0).export(false).unwrap();
    assert!(
        files
            .lines("neighbours.txt")
            .iter()
            .all(|l| l.split(' ').count() >= 2)
    );
    assert!(files.says("images that are not listed get depth maps too"));
}

#[test]
fn openmvs_sml_characters() {
    let files = Neighbours::new(1.0).export(false).unwrap();
    assert!(
        files
            .text("neighbours.txt")
            .chars()
            .all(|c| c.is_ascii_digit() || c == ' ' || c == '\n')
    );
}

#[test]
fn openmvs_neighbors_fix_depth_range() {
    let it = Neighbours::new(5.0);
    let error = it.export(false).err().unwrap();
    assert!(
        error.to_string().contains("0.1 to 100")
            && error.hint().unwrap().to_string().contains("--scale"),
        "{error}"
    );

    let files = it.export(true).unwrap();
    let scaled = Mvs::read(files.bytes("scene.mvs")).unwrap();
    assert!(
        scaled.vertices.is_empty(),
        "without points only the listed images are computed"
    );
    let scale = files.0.record.scale;
    let moved = scaled.platforms[0]
        .poses
        .iter()
        .zip(&it.mvs.platforms[0].poses);
    assert!(
        moved
            .into_iter()
            .all(|(s, p)| (0..3).all(|i| (s.c[i] - scale * p.c[i]).abs() < 1e-9))
    );
    let depth = 40.0 * 5.0 * scale;
    assert!(
        (5.0..20.0).contains(&depth),
        "{depth}: well inside of the searched range"
    );
    assert!(
        files.0.record.commands[1].starts_with("python3 -I unscale.py dense.ply")
            && files.names().contains(&"unscale.py")
    );
}

#[test]
fn an_image_that_the_scene_lacks_is_named() {
    let it = Neighbours::new(1.0);
    let mut mvs = it.mvs.clone();
    let key = format!(
        "undistorted/{}",
        it.fixture.name(it.fixture.clusters[0].key)
    )
    .into_bytes();
    mvs.images
        .iter_mut()
        .filter(|i| i.name == key)
        .for_each(|i| i.name = b"other.jpg".to_vec());
    std::fs::write(it.folder.path().join("scene.mvs"), mvs.write()).unwrap();
    let error = it.export(false).err().unwrap().to_string();
    assert!(
        error.contains(it.fixture.name(it.fixture.clusters[0].key)) && error.contains("has 0"),
        "{error}"
    );
}

#[test]
fn openmvs_bgr_colours() {
    let files = Fixture::new(3).export("openmvs");
    assert!(
        cluster(&files, 1).colours.is_empty(),
        "none are written, so none are swapped"
    );
}

#[test]
fn odm_single_view_points() {
    let mvs = Mvs::read(Fixture::new(3).export("odm").bytes("openmvs/scene.mvs")).unwrap();
    assert!(mvs.vertices.iter().all(|v: &Vertex| v.views.len() == 2));
}

#[test]
fn odm_computes_the_key_views_with_partners_by_points() {
    let fixture = Fixture::new(3);
    let mvs = Mvs::read(fixture.export("odm").bytes("openmvs/scene.mvs")).unwrap();
    assert_eq!(
        computed(&mvs, 2.0),
        [0, 1, 2, 3],
        "ODM leaves View Min Score at 2"
    );
    let name = |i: usize| String::from_utf8(mvs.images[i].name.clone()).unwrap();
    for (key, (_, partners)) in fixture.named().iter().enumerate() {
        let sees = |v: &&Vertex| v.views.iter().any(|s: &VertexView| s.image as usize == key);
        let others = mvs
            .vertices
            .iter()
            .filter(sees)
            .flat_map(|v| &v.views)
            .map(|s| s.image as usize)
            .filter(|i| *i != key);
        let others: std::collections::BTreeSet<String> = others.map(name).collect();
        assert!(
            partners
                .iter()
                .all(|p| others.contains(&format!("../images/{p}")))
        );
    }
}

/// ODM calls OpenMVS with `-w .../openmvs/depthmaps`, in a container under other paths than
/// outside: names are relative to that.
#[test]
fn odm_finds_its_images_wherever_the_project_is_mounted() {
    let fixture = Fixture::new(3);
    let files = fixture.export("odm");
    let mvs = Mvs::read(files.bytes("openmvs/scene.mvs")).unwrap();
    for image in &mvs.images {
        let name = std::str::from_utf8(&image.name).unwrap();
        let from_depthmaps = name
            .strip_prefix("../")
            .expect("relative to openmvs/depthmaps");
        let linked = files.link(&format!("openmvs/{from_depthmaps}"));
        assert_eq!(
            linked,
            std::path::Path::new("/nowhere").join(from_depthmaps)
        );
    }
    assert!(
        files.text("run.sh").contains("\ntried cp -rL openmvs "),
        "a link would lead out of the container"
    );
}

/// The OpenMVS that ODM builds refuses versions above 6. So nothing but the vertices says which
/// images are computed.
#[test]
fn odm_openmvs_fork_version() {
    for k in [1, 2, 5] {
        let mvs = Mvs::read(Fixture::new(k).export("odm").bytes("openmvs/scene.mvs")).unwrap();
        assert_eq!(mvs.version, 6);
        assert_eq!(computed(&mvs, 2.0), [0, 1, 2, 3], "k = {k}");
        let mut ids: Vec<u32> = mvs.images.iter().map(|image| image.id).collect();
        ids.sort_unstable();
        ids.dedup();
        assert_eq!(ids.len(), mvs.images.len(), "ids name depth maps");
    }
}

#[test]
fn odm_rerun_deletes_scene() {
    assert!(Fixture::new(3).export("odm").says("without any --rerun"));
}

#[test]
fn odm_existing_model_skips_stage() {
    assert!(
        Fixture::new(3)
            .export("odm")
            .says("with a scene_dense_dense_filtered.ply the stage is skipped")
    );
}

#[test]
fn odm_number_views_default() {
    assert!(
        Fixture::new(3)
            .export("odm")
            .says("partners beyond the fifth")
    );
}

#[test]
fn openmvs_backslash_name() {
    let mut fixture = Fixture::new(3);
    let key = fixture.clusters[0].key;
    fixture.scene.views[key.index()].name = r"b\15.jpg".into();
    for backend in ["openmvs", "odm"] {
        let error = fixture
            .try_export(backend, &ExportOptions::default())
            .err()
            .unwrap();
        assert!(
            matches!(error, BackendError::Name { .. }),
            "{backend}: {error}"
        );
    }
}

/// OpenMVS keeps the depth maps that it finds in its working folder: a list of other partners needs
/// another one, and none of it lies in the folder of the scene.
#[test]
fn openmvs_existing_dmap_kept_with_lists_of_neighbours() {
    let mut it = Neighbours::new(1.0);
    let work = |files: &Files| {
        let command = files.0.record.commands[0].clone();
        let work = command
            .split("-w \"$PWD/")
            .nth(1)
            .unwrap()
            .split('"')
            .next()
            .unwrap()
            .to_owned();
        assert!(files.is_folder(&work), "{command}");
        work
    };
    let first = work(&it.export(false).unwrap());
    assert_eq!(first, work(&it.export(false).unwrap()));
    it.fixture.choose(&[12, 3, 30, 24], 2);
    assert_ne!(first, work(&it.export(false).unwrap()));
}

#[test]
fn a_name_that_ends_another_one_is_told_from_it() {
    let mut it = Neighbours::new(1.0);
    let views: Vec<ViewIndex> = it.fixture.clusters.iter().map(|c| c.key).take(2).collect();
    let position = |view: ViewIndex| {
        let name = format!("undistorted/{}", it.fixture.name(view)).into_bytes();
        it.mvs
            .images
            .iter()
            .position(|image| image.name == name)
            .unwrap()
    };
    let positions = [position(views[0]), position(views[1])];
    for ((view, position), name) in views.iter().zip(positions).zip(["0.jpg", "b/0.jpg"]) {
        it.fixture.scene.views[view.index()].name = name.into();
        it.mvs.images[position].name = format!("undistorted/{name}").into_bytes();
    }
    std::fs::write(it.folder.path().join("scene.mvs"), it.mvs.write()).unwrap();
    let files = it.export(false).unwrap();
    let first = |line: usize| {
        files.lines("neighbours.txt")[line]
            .split(' ')
            .next()
            .unwrap()
            .to_owned()
    };
    assert_eq!([first(0), first(1)], positions.map(|p| p.to_string()));
}

#[test]
fn the_depths_of_a_scene_without_points_are_those_of_the_model_at_its_size() {
    let mut it = Neighbours::new(5.0);
    it.mvs.vertices.clear();
    std::fs::write(it.folder.path().join("scene.mvs"), it.mvs.write()).unwrap();
    assert!(
        it.export(false)
            .err()
            .unwrap()
            .to_string()
            .contains("0.1 to 100"),
        "5 times as large as the model"
    );
    let key = format!(
        "undistorted/{}",
        it.fixture.name(it.fixture.clusters[0].key)
    )
    .into_bytes();
    let image = it
        .mvs
        .images
        .iter()
        .find(|image| image.name == key)
        .unwrap();
    let (platform, pose) = (image.platform as usize, image.pose as usize);
    it.mvs.platforms[platform].poses[pose].c[0] += 1000.0;
    std::fs::write(it.folder.path().join("scene.mvs"), it.mvs.write()).unwrap();
    assert!(matches!(
        it.export(false).err().unwrap(),
        BackendError::Needs {
            backend: "openmvs",
            ..
        }
    ));
}
