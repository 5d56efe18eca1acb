//! Tests on literal bytes of each format, on files that the programs wrote (`fixtures/depthmaps`),
//! and on corrupted bytes.

mod bounds;
mod dmap;

use std::path::PathBuf;

use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;
use viewrank_core::model::{
    camera::{Camera, CameraModel},
    scene::{CameraIndex, Pose, Scene, View, ViewIndex},
};

use super::*;

const ALL: [DepthMapFormat; 10] = [
    DepthMapFormat::ColmapGeometric,
    DepthMapFormat::ColmapPhotometric,
    DepthMapFormat::OpenMvs,
    DepthMapFormat::Pfm,
    DepthMapFormat::Dmb,
    DepthMapFormat::Npy,
    DepthMapFormat::Gipuma,
    DepthMapFormat::Mve,
    DepthMapFormat::AliceVision,
    DepthMapFormat::MicMac,
];

fn fixture(name: &str) -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
        .join("fixtures/depthmaps")
        .join(name)
}

/// Parses bytes with no other file beside them.
fn parse(bytes: &[u8], format: DepthMapFormat) -> Parsed<DepthMap> {
    super::parse(bytes, format, PixelBound::LARGEST, &|_| {
        Err(std::io::ErrorKind::NotFound.into())
    })
}

const CLOUD: &str = "MM-Malt-Img-IMG_9394/MMLastNuage.xml";

/// Parses the fixture of MicMac, after both changes: to its description, and to the images beside
/// it.
fn micmac(
    xml: impl Fn(String) -> String,
    beside: impl Fn(&str, Vec<u8>) -> Vec<u8>,
) -> Parsed<DepthMap> {
    let path = fixture(CLOUD);
    let text = xml(std::fs::read_to_string(&path).unwrap());
    super::parse(
        text.as_bytes(),
        DepthMapFormat::MicMac,
        PixelBound::LARGEST,
        &|name| Ok(beside(name, std::fs::read(path.with_file_name(name))?)),
    )
}

fn floats_le(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// Expects depths of 10 + row + column / 8 with one hole, as `fixtures/depthmaps/make.py` writes
/// them.
fn assert_is_ramp(map: &DepthMap) {
    assert_eq!((map.width, map.height), (6, 4));
    for (row, column) in (0..4).flat_map(|r| (0..6).map(move |c| (r, c))) {
        let expected = (row, column) != (1, 2);
        let depth = f64::from(row) + f64::from(column) / 8.0 + 10.0;
        assert_eq!(
            map.depth_at(column, row),
            expected.then_some(depth),
            "row {row}, column {column}"
        );
    }
}

#[test]
fn reads_the_files_of_colmap_opencv_and_numpy() {
    for (name, format) in [
        (
            "depth_maps/IMG_9394.jpg.geometric.bin",
            DepthMapFormat::ColmapGeometric,
        ),
        ("00000003.pfm", DepthMapFormat::Pfm),
        ("IMG_9394.jpg.npy", DepthMapFormat::Npy),
    ] {
        assert_is_ramp(&read(&fixture(name), format, PixelBound::LARGEST).unwrap());
    }
}

#[test]
fn reads_a_dmap_written_by_openmvs() {
    let map = read(
        &fixture("depth0040.dmap"),
        DepthMapFormat::OpenMvs,
        PixelBound::LARGEST,
    )
    .unwrap();
    assert_eq!((map.width, map.height), (62, 46));
    assert_eq!(map.ids, [40, 43, 39, 41, 56]);
    // Values from an independent reader in Python.
    assert_eq!(map.depth.iter().filter(|&&z| z > 0.0).count(), 1806);
    assert_eq!(map.depth_at(31, 23), Some(f64::from(55.46964f32)));
    assert_eq!(map.depth_at(0, 0), None);
}

#[test]
fn reads_dmb() {
    // ACMM's writeDepthDmb: type 1, height, width, channels.
    let mut bytes: Vec<u8> = [1i32, 2, 3, 1]
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    bytes.extend(floats_le(&[1.0, 2.0, 3.0, 4.0, -1.0, f32::NAN]));
    let map = parse(&bytes, DepthMapFormat::Dmb).unwrap();
    assert_eq!((map.width, map.height), (3, 2));
    assert_eq!(map.depth, [1.0, 2.0, 3.0, 4.0, 0.0, 0.0]);
    bytes[0] = 2;
    assert!(
        parse(&bytes, DepthMapFormat::Dmb)
            .unwrap_err()
            .1
            .contains("type 2")
    );
}

const MVEI: &str = "view_00000068.mve/depth-L3.mvei";

#[test]
fn reads_a_map_written_by_mves_dmrecon() {
    let map = read(&fixture(MVEI), DepthMapFormat::Mve, PixelBound::LARGEST).unwrap();
    assert_eq!((map.width, map.height), (75, 57));
    // Values from an independent reader in Python.
    assert_eq!(map.depth.iter().filter(|&&z| z > 0.0).count(), 3397);
    assert_eq!(map.depth_at(37, 28), Some(f64::from(24.718979f32)));
    assert_eq!(map.depth_at(0, 0), None);
    let mut colours = std::fs::read(fixture(MVEI)).unwrap();
    colours[19] = 3;
    assert!(
        parse(&colours, DepthMapFormat::Mve)
            .unwrap_err()
            .1
            .contains("3 channels")
    );
}

#[test]
fn reads_openexr_in_the_ways_that_alicevision_writes_it() {
    for name in ["40_depthMap.exr", "41_depthMap.exr"] {
        let map = read(
            &fixture(name),
            DepthMapFormat::AliceVision,
            PixelBound::LARGEST,
        )
        .unwrap();
        assert_eq!((map.width, map.height), (70, 50));
        for (row, column) in (0..50).flat_map(|r| (0..70).map(move |c| (r, c))) {
            let depth = 10.0 + f64::from(row / 5) + f64::from(column / 8) / 8.0;
            assert_eq!(
                map.depth_at(column, row),
                (row % 7 != 0).then_some(depth),
                "{name}: {row}, {column}"
            );
        }
    }
    // Compression 4 is PIZ: named instead of misread.
    let mut bytes = std::fs::read(fixture("40_depthMap.exr")).unwrap();
    let at = bytes
        .windows(12)
        .position(|w| w == b"compression\0")
        .unwrap()
        + 12
        + 12
        + 4;
    assert_eq!(bytes[at], 2);
    bytes[at] = 4;
    assert!(
        parse(&bytes, DepthMapFormat::AliceVision)
            .unwrap_err()
            .1
            .contains("compression 4")
    );
}

#[test]
fn reads_micmacs_inverse_depths_where_the_mask_has_them() {
    let map = read(&fixture(CLOUD), DepthMapFormat::MicMac, PixelBound::LARGEST).unwrap();
    let ramp = read(
        &fixture("00000003.pfm"),
        DepthMapFormat::Pfm,
        PixelBound::LARGEST,
    )
    .unwrap();
    assert_eq!((map.width, map.height), (6, 4));
    assert!(
        map.depth
            .iter()
            .zip(&ramp.depth)
            .all(|(z, expected)| (z - expected).abs() < 1e-5),
        "{:?}",
        map.depth
    );
    assert_eq!(
        map.depth_at(2, 1),
        None,
        "the mask says so: the depth image has a value there, too"
    );
    let unchanged = |_: &str, bytes| bytes;
    let depths = micmac(
        |xml| xml.replace("<ZIsInverse>true", "<ZIsInverse>false"),
        unchanged,
    )
    .unwrap();
    let r = 1.0 / f64::from(map.depth[0]);
    assert!((f64::from(depths.depth[0]) - r).abs() < 1e-6);
    for (from, to, said) in [
        ("<IsSpherik>false", "<IsSpherik>true", "IsSpherik true"),
        (
            "eGeomMNTFaisceauIm1PrCh_Px1D",
            "eGeomMNTFaisceauIm1ZTerrain_Px1D",
            "ZTerrain",
        ),
        ("<DirFaisceaux>0 0 -1", "<DirFaisceaux>0 1 0", "Repere="),
        (
            "<NbPixel>6 4",
            "<NbPixel>6 5",
            "6 x 4 pixels, expected 6 x 5",
        ),
        ("Z_Num8", "../Z_Num8", "same folder"),
        (
            "Z_Num8_DeZoom1_STD-MALT.tif",
            "AutoMask_STD-MALT_Num_7.tif",
            "32-bit floats",
        ),
        ("Z_Num8", "Z_Num9", "Z_Num9_DeZoom1_STD-MALT.tif: "),
        ("<PN3M_Nuage>", "<PN3M_Other>", "not well-formed"),
        ("OrigineAlti>", "Other>", "OrigineAlti"),
    ] {
        let what = micmac(|xml| xml.replace(from, to), unchanged)
            .unwrap_err()
            .1;
        assert!(what.contains(said), "{to}: {what}");
    }
}

#[test]
fn refuses_jpegs_in_micmacs_images() {
    // The entry of the directory for the compression: tag, type, number of values, value.
    let entry = |method: u8| [3, 1, 3, 0, 1, 0, 0, 0, method, 0];
    let compressed = |_: &str, mut bytes: Vec<u8>| {
        let at = bytes.windows(10).position(|window| window == entry(1));
        if let Some(at) = at {
            bytes[at..at + 10].copy_from_slice(&entry(7));
        }
        bytes
    };
    let what = micmac(|xml| xml, compressed).unwrap_err().1;
    assert!(what.contains("JPEG"), "{what}");
}

#[test]
fn micmacs_maps_are_of_distorted_images_and_finished_when_all_is_there() {
    let folder = tempfile::tempdir().unwrap();
    let inside = folder.path().join("MM-Malt-Img-IMG_9394");
    std::fs::create_dir(&inside).unwrap();
    let copy =
        |name: &str| std::fs::copy(fixture(CLOUD).with_file_name(name), inside.join(name)).unwrap();
    let mut scene = scene(&["IMG_9394.jpg", "IMG_9395.jpg"]);
    scene.cameras = vec![
        Camera::new(
            1,
            CameraModel::SimpleRadial,
            12,
            8,
            vec![10.0, 6.0, 4.0, 0.01],
        )
        .unwrap(),
    ];
    copy("MMLastNuage.xml");
    copy("Z_Num8_DeZoom1_STD-MALT.tif");
    let set = list(folder.path(), &scene).unwrap();
    assert!(
        set.maps.is_empty()
            && set.unreadable[0]
                .1
                .to_string()
                .contains("still being matched")
    );
    copy("AutoMask_STD-MALT_Num_7.tif");
    let maps = list(folder.path(), &scene).unwrap().maps;
    assert_eq!(
        maps.iter().map(|map| map.view).collect::<Vec<_>>(),
        [ViewIndex(0)]
    );
    assert!(
        read_of_view(&maps[0], &scene)
            .unwrap()
            .depth_at(0, 0)
            .is_some()
    );
    let files = files_of(folder.path(), &inside.join("MMLastNuage.xml"));
    assert_eq!(
        files[1..],
        ["Z_Num8_DeZoom1_STD-MALT.tif", "AutoMask_STD-MALT_Num_7.tif"]
            .map(|name| inside.join(name))
    );
    assert!(
        files
            .iter()
            .all(|file| is_of_a_map(file.strip_prefix(folder.path()).unwrap()))
    );

    // In an export `run.sh` says what has ended: the depth image is there before that.
    std::fs::create_dir(folder.path().join("ImSec")).unwrap();
    let set = list(folder.path(), &scene).unwrap();
    assert!(set.maps.is_empty() && set.unreadable[0].1.to_string().contains(MICMAC_MARK));
    let mark = inside.join(MICMAC_MARK);
    std::fs::write(&mark, "").unwrap();
    assert_eq!(list(folder.path(), &scene).unwrap().maps.len(), 1);
    assert_eq!(
        files_of(folder.path(), &inside.join("MMLastNuage.xml"))[1..],
        [mark]
    );
}

#[test]
fn distances_from_the_camera_become_depths_along_the_axis() {
    // A wall at z = 9 before a camera of 12 x 8 pixels, in a map of half the size.
    let distance = |column: f64, row: f64| {
        let (x, y) = (
            (2.0 * column + 1.0 - 6.0) / 10.0,
            (2.0 * row + 1.0 - 4.0) / 10.0,
        );
        9.0 * (x * x + y * y + 1.0f64).sqrt() as f32
    };
    let distances: Vec<f32> = (0..24)
        .map(|i| distance(f64::from(i % 6), f64::from(i / 6)))
        .collect();
    let mut bytes = b"\x89MVE_IMAGE\n".to_vec();
    bytes.extend([6i32, 4, 1, 9].iter().flat_map(|v| v.to_le_bytes()));
    bytes.extend(floats_le(&distances));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("depth-L1.mvei");
    std::fs::write(&path, bytes).unwrap();
    let file = DepthMapFile {
        view: ViewIndex(0),
        path,
        format: DepthMapFormat::Mve,
    };
    let map = read_of_view(&file, &scene(&["a.jpg"])).unwrap();
    assert!(
        map.depth.iter().all(|z| (z - 9.0).abs() < 1e-5),
        "{:?}",
        map.depth
    );
}

#[test]
fn depths_that_patchmatchnet_has_no_confidence_in_are_none() {
    let folder = tempfile::tempdir().unwrap();
    let write = |kind: &str, width: u32, values: &[f32]| {
        let path = folder.path().join(kind).join("00000003.pfm");
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let header = format!("Pf\n{width} {}\n-1.0\n", values.len() / width as usize);
        std::fs::write(&path, [header.as_bytes(), &floats_le(values)].concat()).unwrap();
        path
    };
    let path = write("depth_est", 3, &[4.0, 5.0, 6.0, 1.0, 2.0, 3.0]);
    let file = DepthMapFile {
        view: ViewIndex(0),
        path,
        format: DepthMapFormat::Pfm,
    };
    let depths = || read_of_view(&file, &scene(&["a.jpg"])).map(|map| map.depth);
    assert_eq!(
        depths().unwrap(),
        [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        "no confidences, no holes"
    );
    write("confidence", 3, &[0.9, 0.1, 0.51, 0.0, 0.6, 0.5]);
    assert_eq!(depths().unwrap(), [0.0, 2.0, 0.0, 4.0, 0.0, 6.0]);
    write("confidence", 3, &[f32::NAN; 6]);
    assert_eq!(depths().unwrap(), [0.0; 6]);
    write("confidence", 2, &[0.9; 6]);
    assert!(
        depths()
            .unwrap_err()
            .to_string()
            .contains("2 x 3 pixels, but the depth map has 3 x 2 pixels")
    );
}

#[test]
fn reads_big_endian_pfm_from_the_bottom_up() {
    let mut bytes = b"Pf\n2 2\n1.0\n".to_vec();
    bytes.extend([3.0f32, 4.0, 1.0, 2.0].iter().flat_map(|v| v.to_be_bytes()));
    assert_eq!(
        parse(&bytes, DepthMapFormat::Pfm).unwrap().depth,
        [1.0, 2.0, 3.0, 4.0]
    );
}

#[test]
fn a_pfm_of_another_size_has_the_nearest_pixel_at_each_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.pfm");
    let write = |bytes: &[u8]| std::fs::write(&path, bytes).unwrap();
    let mut bytes = b"Pf\n2 2\n1.0\n".to_vec();
    bytes.extend([3.0f32, 4.0, 1.0, 2.0].iter().flat_map(|v| v.to_be_bytes()));
    write(&bytes);
    assert_eq!(pfm::whole_size(&path).unwrap(), [2, 2]);
    let wider = pfm::resized(&path, PixelBound::new(4), [4, 1]).unwrap();
    let wider = parse(&wider, DepthMapFormat::Pfm).unwrap();
    assert_eq!((wider.width, wider.height), (4, 1));
    assert_eq!(wider.depth, [1.0, 1.0, 2.0, 2.0]);
    let higher = pfm::resized(&path, PixelBound::new(4), [2, 4]).unwrap();
    let higher = parse(&higher, DepthMapFormat::Pfm).unwrap().depth;
    assert_eq!(higher, [1.0, 2.0, 1.0, 2.0, 3.0, 4.0, 3.0, 4.0]);
    // Of a map that has grown since its size was read.
    assert!(pfm::resized(&path, PixelBound::new(3), [1, 1]).is_err());
    for cut in [
        &bytes[..bytes.len() - 1],
        &bytes[..6],
        b"Pf\n0 0\n-1\n",
        b"PF\n1 1\n-1\n",
    ] {
        write(cut);
        assert!(
            pfm::whole_size(&path).is_err()
                && pfm::resized(&path, PixelBound::new(4), [1, 1]).is_err()
        );
    }
}

#[test]
fn errors_identify_normal_maps_and_truncated_files() {
    let mut normals = b"2&1&3&".to_vec();
    normals.extend(floats_le(&[0.0; 6]));
    assert!(
        parse(&normals, DepthMapFormat::ColmapGeometric)
            .unwrap_err()
            .1
            .contains("normal map")
    );
    let mut truncated = b"2&2&1&".to_vec();
    truncated.extend(floats_le(&[1.0; 3]));
    let (byte, what) = parse(&truncated, DepthMapFormat::ColmapGeometric).unwrap_err();
    assert_eq!(
        (byte, what.as_str()),
        (18, "2 x 2 pixels need 16 bytes, 12 are left")
    );
}

#[test]
fn a_map_that_ends_too_early_is_unfinished_until_it_stays_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.jpg.geometric.bin");
    let error = |bytes: &[u8], age: u64| {
        std::fs::write(&path, bytes).unwrap();
        let file = std::fs::File::options().write(true).open(&path).unwrap();
        let changed = std::time::SystemTime::now() - std::time::Duration::from_secs(age);
        file.set_modified(changed).unwrap();
        read(&path, DepthMapFormat::ColmapGeometric, PixelBound::LARGEST).unwrap_err()
    };
    let cut = [&b"2&2&1&"[..], &floats_le(&[1.0; 3])].concat();
    for cut in [&cut[..], b"2&2", b""] {
        assert!(matches!(error(cut, 0), DepthMapError::Unfinished { .. }));
        assert!(matches!(error(cut, 3600), DepthMapError::Format { .. }));
    }
    let normals = [&b"2&1&3&"[..], &floats_le(&[0.0; 6])].concat();
    assert!(matches!(error(&normals, 0), DepthMapError::Format { .. }));
}

#[test]
fn sizes_larger_than_the_file_are_refused() {
    let hostile: [(&[u8], DepthMapFormat); 4] = [
        (b"4294967295&4294967295&1&\0\0\0\0", DepthMapFormat::ColmapGeometric),
        (b"Pf\n4294967295 4294967295\n-1\n\0\0\0\0", DepthMapFormat::Pfm),
        (b"\x01\0\0\0\xff\xff\xff\xff\xff\xff\xff\xff\x01\0\0\0\0\0\0\0", DepthMapFormat::Dmb),
        (
            b"\x93NUMPY\x01\0\x50\0{'descr': '<f4', 'fortran_order': False, 'shape': (4294967295, 4294967295), }  \n",
            DepthMapFormat::Npy,
        ),
    ];
    for (bytes, format) in hostile {
        assert!(parse(bytes, format).is_err(), "{format:?}");
    }
}

#[test]
fn deep_nesting_in_a_numpy_header_is_refused() {
    let mut bytes = b"\x93NUMPY\x02\0\0\0\x01\0".to_vec();
    bytes.extend(std::iter::repeat_n(b'(', 1 << 16));
    assert!(
        parse(&bytes, DepthMapFormat::Npy)
            .unwrap_err()
            .1
            .contains("longer")
    );
    // The longest header that is parsed.
    let mut bytes = b"\x93NUMPY\x01\0\0\x02".to_vec();
    bytes.extend(std::iter::repeat_n(b'(', 512));
    assert!(parse(&bytes, DepthMapFormat::Npy).is_err());
}

proptest! {
    #[test]
    fn no_reader_panics_on_random_bytes(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
        for format in ALL {
            let _ = parse(&bytes, format);
        }
    }

    #[test]
    fn no_reader_panics_on_a_damaged_file(at in 0usize..700, byte: u8, keep in 0usize..700) {
        for (name, format) in [
            ("depth_maps/IMG_9394.jpg.geometric.bin", DepthMapFormat::ColmapGeometric),
            ("00000003.pfm", DepthMapFormat::Pfm),
            ("IMG_9394.jpg.npy", DepthMapFormat::Npy),
            ("depth0040.dmap", DepthMapFormat::OpenMvs),
            (MVEI, DepthMapFormat::Mve),
            ("40_depthMap.exr", DepthMapFormat::AliceVision),
            ("41_depthMap.exr", DepthMapFormat::AliceVision),
        ] {
            let mut bytes = std::fs::read(fixture(name)).unwrap();
            let at = at % bytes.len();
            bytes[at] = byte;
            let _ = parse(&bytes, format);
            bytes.truncate(keep);
            let _ = parse(&bytes, format);
        }
        let changed = |mut bytes: Vec<u8>| {
            let at = at % bytes.len();
            bytes[at] = byte;
            bytes
        };
        let _ = micmac(|xml| String::from_utf8_lossy(&changed(xml.into())).into_owned(), |_, bytes| bytes);
        for image in ["Z_", "Auto"] {
            // Most of a TIFF's head is in the first 250 bytes here.
            let damaged = |name: &str, bytes| if name.starts_with(image) { changed(bytes) } else { bytes };
            let _ = micmac(|xml| xml, damaged);
        }
    }
}

fn camera() -> Camera {
    Camera::new(1, CameraModel::Pinhole, 12, 8, vec![10.0, 10.0, 6.0, 4.0]).unwrap()
}

fn scene(names: &[&str]) -> Scene {
    let cam_from_world = Pose {
        rotation: Rotation3::identity(),
        translation: Vector3::zeros(),
    };
    let view = |(i, name): (usize, &&str)| View {
        name: name.to_string(),
        image_id: i as u32,
        file_position: i as u32,
        camera: CameraIndex(0),
        cam_from_world,
    };
    Scene {
        cameras: vec![camera()],
        views: names.iter().enumerate().map(view).collect(),
        track_offsets: vec![0],
        ..Default::default()
    }
}

#[test]
fn pixel_at_inverts_image_position() {
    let map = read(
        &fixture("00000003.pfm"),
        DepthMapFormat::Pfm,
        PixelBound::LARGEST,
    )
    .unwrap();
    assert_eq!(map.pixel_size(&camera()), (2.0, 2.0));
    assert_eq!(map.image_position(&camera(), 0, 0), Point2::new(1.0, 1.0));
    for (column, row) in (0..6).flat_map(|c| (0..4).map(move |r| (c, r))) {
        let position = map.image_position(&camera(), column, row);
        assert_eq!(map.pixel_at(&camera(), &position), Some((column, row)));
    }
    assert_eq!(map.pixel_at(&camera(), &Point2::new(12.0, 3.0)), None);
    assert_eq!(map.pixel_at(&camera(), &Point2::new(-0.1, 3.0)), None);
}

/// A folder with these files (name, fixture to copy).
fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, from) in files {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::copy(fixture(from), path).unwrap();
    }
    folder
}

fn found(set: &DepthMapSet) -> Vec<(u32, DepthMapFormat)> {
    set.maps.iter().map(|m| (m.view.0, m.format)).collect()
}

const BIN: &str = "depth_maps/IMG_9394.jpg.geometric.bin";

#[test]
fn prefers_colmaps_geometric_maps_and_ignores_normal_maps() {
    let scene = scene(&["IMG_9394.jpg", "flight 1/IMG_9394.jpg"]);
    let folder = folder(&[
        ("depth_maps/IMG_9394.jpg.photometric.bin", BIN),
        ("depth_maps/IMG_9394.jpg.geometric.bin", BIN),
        ("depth_maps/flight 1/IMG_9394.jpg.photometric.bin", BIN),
        ("depth_maps/other.jpg.photometric.bin", BIN),
        ("normal_maps/IMG_9394.jpg.geometric.bin", BIN),
        // What a killed task was making.
        (
            "stereo/viewrank/unfinished/a1/stereo/depth_maps/flight 1/IMG_9394.jpg.photometric.bin",
            BIN,
        ),
    ]);
    let set = find(folder.path(), &scene).unwrap();
    assert_eq!(
        found(&set),
        [
            (0, DepthMapFormat::ColmapGeometric),
            (1, DepthMapFormat::ColmapPhotometric)
        ]
    );
    assert_eq!(
        set.unassigned,
        [folder.path().join("depth_maps/other.jpg.photometric.bin")]
    );
}

#[test]
fn a_map_of_colmap_is_whole_at_one_length_alone() {
    let folder = folder(&[("a.bin", BIN)]);
    let path = folder.path().join("a.bin");
    let bytes = std::fs::read(&path).unwrap();
    let size = |bytes: &[u8], channels| {
        std::fs::write(&path, bytes).unwrap();
        colmap::whole_size(&path, channels)
    };
    assert_eq!(size(&bytes, 1).unwrap(), [6, 4]);
    let longer = [&*bytes, &[0]].concat();
    for (bytes, channels, why) in [
        (
            &bytes[..bytes.len() - 1],
            1,
            "6 x 4 pixels need 102 bytes, 101 are there",
        ),
        (&longer, 1, "102 bytes, 103 are there"),
        (&bytes, 3, "1 channels, expected 3"),
        (b"0&4&1&", 1, "0 x 4 pixels"),
        (b"4294967295&4294967295&1&", 1, "18446744073709551615 bytes"),
        (b"6&4", 1, "expected `WIDTH&HEIGHT&CHANNELS&`"),
        (b"", 1, "expected"),
    ] {
        let said = size(bytes, channels).unwrap_err().to_string();
        assert!(said.contains(why), "{said}");
    }
}

#[test]
fn finds_the_view_of_a_dmap_by_the_image_in_it() {
    let scene = scene(&["IMG_9394.jpg", "IMG_9395.jpg"]);
    let dmap = "depth0040.dmap";
    let folder = folder(&[("depth0007.dmap", dmap), ("depth0007.geo.dmap", dmap)]);
    assert_eq!(
        found(&find(folder.path(), &scene).unwrap()),
        [(1, DepthMapFormat::OpenMvs)]
    );
}

#[test]
fn numbered_maps_need_the_list_of_names() {
    let scene = scene(&["a.jpg", "b.jpg"]);
    let pfm = "00000003.pfm";
    let folder = folder(&[
        ("depth_est/00000003.pfm", pfm),
        ("confidence/00000003.pfm", pfm),
    ]);
    assert!(matches!(
        find(folder.path(), &scene),
        Err(DepthMapError::Names { .. })
    ));
    std::fs::write(folder.path().join("view_names.txt"), "2\ta.jpg\n3\tb.jpg\n").unwrap();
    assert_eq!(
        found(&find(&folder.path().join("depth_est"), &scene).unwrap()),
        [(1, DepthMapFormat::Pfm)]
    );
}

#[test]
fn maps_of_mve_gipuma_and_alicevision_are_those_of_the_plan() {
    let scene = scene(&["flight_1/IMG_9395.jpg", "grid_033.jpg", "zero.jpg"]);
    let dmb = "00000003.pfm";
    let folder = folder(&[
        // MVE: the view is named in meta.ini; the map of the larger scale counts.
        (
            "mve/views/view_00000001.mve/meta.ini",
            "view_00000068.mve/meta.ini",
        ),
        ("mve/views/view_00000001.mve/depth-L3.mvei", MVEI),
        ("mve/views/view_00000001.mve/depth-L2.mvei", MVEI),
        ("mve/views/view_00000001.mve/conf-L2.mvei", MVEI),
        ("mve/older/view_00000001.maps/depth-L0.mvei", MVEI),
        // AliceVision: by the id of the image; filtered maps count.
        ("alicevision/depthMaps/2_depthMap.exr", "40_depthMap.exr"),
        ("alicevision/filtered/2_depthMap.exr", "41_depthMap.exr"),
        ("alicevision/depthMaps/2_simMap.exr", "40_depthMap.exr"),
        // Gipuma: by the name of the image in that of the folder.
        ("gipuma/results/2_20260101_120000_IMG_9395/disp.dmb", dmb),
        ("gipuma/older/2_20260101_110000_IMG_9395/disp.dmb", dmb),
    ]);
    let views = |name: &str| {
        let set = find(&folder.path().join(name), &scene).unwrap();
        assert!(set.unassigned.is_empty() && set.unreadable.is_empty());
        let path = set.maps[0]
            .path
            .strip_prefix(folder.path())
            .unwrap()
            .to_string_lossy()
            .replace('\\', "/");
        (found(&set), path)
    };
    let mve = views("mve");
    assert_eq!(
        mve,
        (
            vec![(1, DepthMapFormat::Mve)],
            "mve/views/view_00000001.mve/depth-L2.mvei".into()
        )
    );
    let alicevision = views("alicevision");
    assert_eq!(
        alicevision,
        (
            vec![(2, DepthMapFormat::AliceVision)],
            "alicevision/filtered/2_depthMap.exr".into()
        )
    );
    assert_eq!(views("gipuma").0, [(0, DepthMapFormat::Gipuma)]);
}

#[test]
fn the_export_for_gipuma_numbers_its_results() {
    let scene = scene(&["a.jpg", "b.jpg"]);
    let folder = folder(&[("results/2_7f3a_00000012/disp.dmb", "00000003.pfm")]);
    std::fs::write(
        folder.path().join("view_names.txt"),
        "00000011.jpg\ta.jpg\n00000012.jpg\tb.jpg\n",
    )
    .unwrap();
    assert_eq!(
        found(&find(folder.path(), &scene).unwrap()),
        [(1, DepthMapFormat::Gipuma)]
    );
}

#[test]
fn two_maps_of_one_view_are_an_error_that_names_both() {
    let scene = scene(&["IMG_9394.jpg"]);
    let npy = "IMG_9394.jpg.npy";
    let folder = folder(&[
        ("a/IMG_9394.jpg.npy", npy),
        ("b/IMG_9394.jpg.npy", npy),
        ("b/counts/IMG_9394.jpg.npy", npy),
    ]);
    let error = find(folder.path(), &scene).unwrap_err();
    let DepthMapError::Duplicate {
        view,
        first,
        second,
    } = &error
    else {
        panic!("{error}")
    };
    assert_eq!(view, "IMG_9394.jpg");
    assert!(first.ends_with("a/IMG_9394.jpg.npy") && second.ends_with("b/IMG_9394.jpg.npy"));
}

#[test]
fn an_unreadable_map_is_listed_without_hiding_the_others() {
    let scene = scene(&["IMG_9394.jpg", "IMG_9395.jpg"]);
    let folder = folder(&[
        ("depth0040.dmap", "depth0040.dmap"),
        ("IMG_9394.jpg.npy", "IMG_9394.jpg.npy"),
    ]);
    std::fs::write(folder.path().join("depth0001.dmap"), "DR").unwrap();
    std::fs::write(folder.path().join("00000007.pfm"), "").unwrap();
    let set = find(folder.path(), &scene).unwrap();
    assert_eq!(
        found(&set),
        [(0, DepthMapFormat::Npy), (1, DepthMapFormat::OpenMvs)]
    );
    let unreadable: Vec<_> = set
        .unreadable
        .iter()
        .map(|(path, _)| path.file_name().unwrap())
        .collect();
    assert_eq!(unreadable, ["00000007.pfm", "depth0001.dmap"]);
    assert!(matches!(
        set.into_complete(),
        Err(DepthMapError::Names { .. })
    ));
    for name in ["depth0040.dmap", "IMG_9394.jpg.npy", "00000007.pfm"] {
        std::fs::remove_file(folder.path().join(name)).unwrap();
    }
    assert!(list(folder.path(), &scene).unwrap().maps.is_empty());
    assert!(matches!(
        find(folder.path(), &scene),
        Err(DepthMapError::Unfinished { .. })
    ));
}

#[test]
fn a_folder_without_maps_is_an_error() {
    let folder = folder(&[("else.txt", BIN)]);
    assert!(matches!(
        find(folder.path(), &scene(&["a.jpg"])),
        Err(DepthMapError::None(_))
    ));
    assert!(matches!(
        find(&folder.path().join("no"), &scene(&["a.jpg"])),
        Err(DepthMapError::Io { .. })
    ));
    assert_eq!(ViewIndex(0), scene(&["a.jpg"]).find("a.jpg").unwrap());
}

#[test]
fn colmaps_maps_are_found_in_its_export_where_there_is_no_dense_workspace() {
    let folder = tempfile::tempdir().unwrap();
    let (project, dense) = (folder.path(), folder.path().join("dense"));
    let [own, of_dense] =
        ["viewrank/colmap", "dense"].map(|above| project.join(above).join("stereo/depth_maps"));
    assert_eq!(folder_of(project, None, "colmap").as_ref(), Some(&own));
    assert_eq!(
        folder_of(project, Some(&dense), "colmap").as_ref(),
        Some(&of_dense)
    );
    std::fs::create_dir_all(&own).unwrap();
    assert_eq!(
        folder_of(project, Some(&dense), "colmap").as_ref(),
        Some(&own)
    );
    std::fs::create_dir_all(&of_dense).unwrap();
    assert_eq!(
        folder_of(project, Some(&dense), "colmap").as_ref(),
        Some(&of_dense)
    );
}

#[cfg(unix)]
#[test]
fn default_folders_behind_links_out_of_the_project_are_left_out() {
    use std::os::unix::fs::symlink;
    let folder = tempfile::tempdir().unwrap();
    let (project, outside) = (folder.path().join("p"), folder.path().join("outside"));
    let here = project.join("stereo/depth_maps");
    for folder in [&here, &outside.join("stereo/depth_maps")] {
        std::fs::create_dir_all(folder).unwrap();
    }
    symlink(&outside, project.join("dense")).unwrap();
    symlink(&outside, project.join("sgm")).unwrap();
    symlink("stereo", project.join("depth_maps")).unwrap();
    assert_eq!(folders(&project), [here, project.join("depth_maps")]);
    let own = project.join("viewrank/sgm");
    assert_eq!(folder_of(&project, None, "sgm").as_ref(), Some(&own));
    symlink(&outside, project.join("other")).unwrap();
    assert_eq!(folder_of(&project, None, "other"), None);
}
