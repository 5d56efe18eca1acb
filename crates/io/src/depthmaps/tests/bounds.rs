//! Maps of more pixels than their view, and files of more bytes than their map.

use super::*;

/// Files of all formats and their pixels.
const MAPS: [(&str, DepthMapFormat, u64); 8] = [
    (
        "depth_maps/IMG_9394.jpg.geometric.bin",
        DepthMapFormat::ColmapGeometric,
        24,
    ),
    ("00000003.pfm", DepthMapFormat::Pfm, 24),
    ("IMG_9394.jpg.npy", DepthMapFormat::Npy, 24),
    ("depth0040.dmap", DepthMapFormat::OpenMvs, 62 * 46),
    (MVEI, DepthMapFormat::Mve, 75 * 57),
    ("40_depthMap.exr", DepthMapFormat::AliceVision, 70 * 50),
    ("41_depthMap.exr", DepthMapFormat::AliceVision, 70 * 50),
    (CLOUD, DepthMapFormat::MicMac, 24),
];

#[test]
fn a_map_of_more_pixels_than_its_bound_is_refused() {
    for (name, format, pixels) in MAPS {
        assert!(
            read(&fixture(name), format, PixelBound::new(pixels)).is_ok(),
            "{name}"
        );
        let error = read(&fixture(name), format, PixelBound::new(pixels - 1))
            .unwrap_err()
            .to_string();
        assert!(
            error.ends_with(&format!("pixels, at most {} are read here", pixels - 1)),
            "{name}: {error}"
        );
    }
    let dmb: Vec<u8> = [1i32, 2, 3, 1]
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .chain([0; 24])
        .collect();
    let nothing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
    for format in [DepthMapFormat::Dmb, DepthMapFormat::Gipuma] {
        assert!(super::super::parse(&dmb, format, PixelBound::new(6), &nothing).is_ok());
        assert!(super::super::parse(&dmb, format, PixelBound::new(5), &nothing).is_err());
    }
}

#[test]
fn a_map_of_a_view_has_at_most_the_pixels_of_its_camera() {
    let mut scene = scene(&["IMG_9394.jpg"]);
    let file = DepthMapFile {
        view: ViewIndex(0),
        path: fixture("00000003.pfm"),
        format: DepthMapFormat::Pfm,
    };
    assert!(read_of_view(&file, &scene).is_ok());
    scene.cameras =
        vec![Camera::new(1, CameraModel::Pinhole, 3, 2, vec![10.0, 10.0, 1.5, 1.0]).unwrap()];
    let error = read_of_view(&file, &scene).unwrap_err().to_string();
    assert!(
        error.ends_with("6 x 4 pixels, at most 12 are read here"),
        "{error}"
    );
}

#[test]
fn an_exr_that_claims_any_size_is_refused_before_memory_is_taken_for_it() {
    let mut bytes = std::fs::read(fixture("40_depthMap.exr")).unwrap();
    let at = bytes
        .windows(11)
        .position(|w| w == b"dataWindow\0")
        .unwrap()
        + 11
        + 6
        + 4;
    for side in [123_999i32, i32::MAX - 1] {
        for (axis, value) in [0, 0, side, side].into_iter().enumerate() {
            bytes[at + 4 * axis..][..4].copy_from_slice(&value.to_le_bytes());
        }
        let what = parse(&bytes, DepthMapFormat::AliceVision).unwrap_err().1;
        assert!(
            what.starts_with(&format!("{} x {0} pixels, at most", side + 1)),
            "{what}"
        );
    }
}

#[test]
fn bytes_behind_a_map_are_not_read() {
    let folder = tempfile::tempdir().unwrap();
    for (name, format, pixels) in MAPS
        .into_iter()
        .filter(|(.., format, _)| *format != DepthMapFormat::MicMac)
    {
        let path = folder.path().join("map");
        std::fs::copy(fixture(name), &path).unwrap();
        let map = read(&path, format, PixelBound::new(pixels)).unwrap();
        // More than is read of any file: a hole costs nothing.
        std::fs::File::options()
            .write(true)
            .open(&path)
            .unwrap()
            .set_len(200 << 20)
            .unwrap();
        assert_eq!(
            read(&path, format, PixelBound::new(pixels)).unwrap(),
            map,
            "{name}"
        );
    }
}
