//! OpenMVS's maps of the kind `D2`, written here after the description of the format: halves are
//! made from their bits, not by the library that reads them.

use super::*;

/// A `D2` map as OpenMVS's develop of 2026 writes it.
#[derive(Clone, Debug)]
struct D2 {
    kind: u8,
    exponent: i8,
    size: [u32; 2],
    /// Bits of the depths divided by 2^exponent.
    halves: Vec<u16>,
    ids: Vec<u32>,
    name: &'static str,
}

impl D2 {
    /// 2 x 2 pixels: none, 1.0, 1.5 and the largest half, 65504, times eight.
    fn small() -> Self {
        Self {
            kind: 0b1111,
            exponent: 3,
            size: [2, 2],
            halves: vec![0, 0x3C00, 0x3E00, 0x7BFF],
            ids: vec![40, 43, 39],
            name: "images/IMG_9395.jpg",
        }
    }

    fn bytes(&self) -> Vec<u8> {
        let mut bytes = b"D2".to_vec();
        bytes.extend([self.kind, self.exponent.cast_unsigned()]);
        for length in self.size.map(|side| side * 4).into_iter().chain(self.size) {
            bytes.extend(length.to_le_bytes());
        }
        bytes.extend(floats_le(&[0.5, 99.0, 1.0]));
        bytes.extend((self.name.len() as u16).to_le_bytes());
        bytes.extend(self.name.bytes());
        bytes.extend((self.ids.len() as u32).to_le_bytes());
        bytes.extend(self.ids.iter().flat_map(|id| id.to_le_bytes()));
        bytes.extend([0; 21 * 8]);
        bytes.extend(self.halves.iter().flat_map(|half| half.to_le_bytes()));
        // Normals, confidences and views.
        let pixels = self.halves.len();
        for (bit, width) in [(1, 4), (2, 1), (3, 4)] {
            let there = usize::from(self.kind >> bit & 1);
            bytes.extend(vec![0xA5; width * there * pixels]);
        }
        bytes
    }
}

/// Value of a half: sign, 5 bits of exponent, 10 of mantissa.
fn value(half: u16) -> f64 {
    let (sign, exponent, mantissa) = (half >> 15, i32::from(half >> 10 & 31), half & 1023);
    let size = match exponent {
        0 => f64::from(mantissa) * 2f64.powi(-24),
        31 => f64::NAN,
        _ => f64::from(1024 + mantissa) * 2f64.powi(exponent - 25),
    };
    if sign == 1 { -size } else { size }
}

/// Reads bytes as a file of the name in a folder, within the bound.
fn read_bytes(bytes: &[u8], bound: PixelBound) -> Result<DepthMap, DepthMapError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("depth0040.dmap");
    std::fs::write(&path, bytes).unwrap();
    read(&path, DepthMapFormat::OpenMvs, bound)
}

#[test]
fn depths_of_the_new_kind_are_halves_times_a_power_of_two() {
    let map = parse(&D2::small().bytes(), DepthMapFormat::OpenMvs).unwrap();
    assert_eq!((map.width, map.height), (2, 2));
    assert_eq!(map.ids, [40, 43, 39]);
    assert_eq!(map.depth, [0.0, 8.0, 12.0, 524_032.0]);
    let without = D2 {
        kind: 1,
        exponent: -10,
        halves: vec![0x3C00, 0x0001, 0x8000, 0xBC00],
        ..D2::small()
    };
    let map = parse(&without.bytes(), DepthMapFormat::OpenMvs).unwrap();
    assert_eq!(map.depth, [1.0 / 1024.0, 2f32.powi(-34), 0.0, 0.0]);
}

#[test]
fn unknown_bits_of_the_new_kind_are_no_planes() {
    let flagged = D2 {
        kind: 0b1001_1111,
        ..D2::small()
    };
    assert_eq!(
        parse(&flagged.bytes(), DepthMapFormat::OpenMvs),
        parse(&D2::small().bytes(), DepthMapFormat::OpenMvs)
    );
}

#[test]
fn a_map_of_an_unknown_kind_is_newer_and_not_damaged() {
    let mut of_other_letters = D2::small().bytes();
    of_other_letters[1] = b'3';
    let mut with_other_planes = std::fs::read(fixture("depth0040.dmap")).unwrap();
    with_other_planes[2] |= 1 << 4;
    for (bytes, kind) in [
        (of_other_letters.clone(), "a depth map of kind `D3`"),
        (b"\xFFX".to_vec(), "a depth map of kind `\\xffX`"),
        (with_other_planes, "a depth map of kind `DR` and type 23"),
    ] {
        let error = read_bytes(&bytes, PixelBound::LARGEST).unwrap_err();
        let DepthMapError::Newer { kind: found, .. } = &error else {
            panic!("{error}");
        };
        assert_eq!(found, kind);
        assert!(
            error
                .hint()
                .unwrap()
                .to_string()
                .starts_with("use a newer viewrank")
        );
    }
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("depth0001.dmap"), of_other_letters).unwrap();
    let found = list(folder.path(), &scene(&["IMG_9395.jpg"])).unwrap();
    assert!(matches!(
        &found.unreadable[..],
        [(_, DepthMapError::Newer { .. })]
    ));
    // Not yet written.
    for bytes in [&b""[..], b"DR", b"\0\0\0\0"] {
        let error = read_bytes(bytes, PixelBound::LARGEST).unwrap_err();
        assert!(!matches!(error, DepthMapError::Newer { .. }), "{error}");
    }
}

#[test]
fn maps_of_both_kinds_are_found_by_the_image_in_them() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("depth0040.dmap"), D2::small().bytes()).unwrap();
    let set = list(folder.path(), &scene(&["IMG_9395.jpg"])).unwrap();
    assert_eq!(found(&set), [(0, DepthMapFormat::OpenMvs)]);
    let ids = ids_of(&folder.path().join("depth0040.dmap")).unwrap();
    assert_eq!(ids, [40, 43, 39]);
}

#[test]
fn the_image_of_a_map_may_have_another_extension_than_its_name_in_the_model() {
    let folder = tempfile::tempdir().unwrap();
    let image = |name| {
        D2 {
            name,
            ..D2::small()
        }
        .bytes()
    };
    let path = folder.path().join("depth0040.dmap");
    for (names, image_name, view) in [
        (
            &["IMG_9394.JPG", "IMG_9395.JPG"][..],
            "images/IMG_9395.png",
            Some(1),
        ),
        (&["IMG_9394", "IMG_9395"], "images/IMG_9395.jpg", Some(1)),
        (&["IMG.9394", "IMG.9395"], "images/IMG.9395.jpg", Some(1)),
        (&["1/a.tif", "2/a.tif", "a.tif"], "images/2/a.png", Some(1)),
        (&["a.tif", "a.bmp"], "images/a.png", None),
        (&["a.tif", "a.png"], "images/a.png", Some(1)),
        (&["aa.tif"], "images/a.png", None),
        (&["a.tif"], "images/aa.png", None),
    ] {
        std::fs::write(&path, image(image_name)).unwrap();
        let set = list(folder.path(), &scene(names)).unwrap();
        let wanted: Vec<_> = view
            .map(|view| (view, DepthMapFormat::OpenMvs))
            .into_iter()
            .collect();
        assert_eq!(found(&set), wanted, "{names:?} {image_name}");
    }
}

#[test]
fn maps_that_a_killed_run_was_making_or_fusing_are_not_found() {
    let folder = tempfile::tempdir().unwrap();
    for place in ["", "unfinished/0040-a1", "unfinished/fusion-b2"] {
        let place = folder.path().join(place);
        std::fs::create_dir_all(&place).unwrap();
        std::fs::write(place.join("depth0040.dmap"), D2::small().bytes()).unwrap();
    }
    let set = list(folder.path(), &scene(&["IMG_9395.jpg"])).unwrap();
    assert_eq!(found(&set), [(0, DepthMapFormat::OpenMvs)]);
}

#[test]
fn hostile_maps_of_the_new_kind_are_refused() {
    let with = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = D2::small().bytes();
        change(&mut bytes);
        parse(&bytes, DepthMapFormat::OpenMvs).unwrap_err().1
    };
    let put =
        |at: usize, value: &[u8]| with(&|bytes| bytes[at..at + value.len()].copy_from_slice(value));
    let ids = 32 + 2 + D2::small().name.len();
    assert!(put(12, &[0xFF; 8]).starts_with("4294967295 x 4294967295 pixels, at most"));
    assert!(put(12, &[0; 4]).contains("no pixels"));
    assert!(put(12, &1000u32.to_le_bytes()).contains("need 4000 bytes"));
    assert!(put(32, &[0xFF; 2]).starts_with("the header ends too early"));
    assert!(put(ids, &[0xFF; 4]).starts_with("the header ends too early"));
    assert!(put(2, &[0b1110]).contains("no depth plane"));
    for length in 0..ids + 4 + 12 + 168 + 8 {
        assert!(
            !with(&|bytes| bytes.truncate(length)).is_empty(),
            "{length}"
        );
    }
    let camera = PixelBound::new(3);
    let error = read_bytes(&D2::small().bytes(), camera).unwrap_err();
    assert!(
        error
            .to_string()
            .ends_with("2 x 2 pixels, at most 3 are read here")
    );
}

proptest! {
    #[test]
    fn every_half_and_exponent_is_read_as_its_value(
        bits in proptest::collection::vec(any::<u16>(), 6),
        exponent: i8,
        kind in any::<u8>().prop_map(|kind| kind | 1),
        ids in proptest::collection::vec(any::<u32>(), 0..20),
    ) {
        let map = D2 { kind, exponent, size: [3, 2], halves: bits.clone(), ids: ids.clone(), name: "a" };
        let read = parse(&map.bytes(), DepthMapFormat::OpenMvs).unwrap();
        let expected: Vec<f32> = bits
            .iter()
            .map(|&half| (value(half) * 2f64.powi(exponent.into())) as f32)
            .map(|z| if z > 0.0 && z.is_finite() { z } else { 0.0 })
            .collect();
        prop_assert_eq!(read.depth, expected);
        prop_assert_eq!(read.ids, ids);
    }

    #[test]
    fn no_damage_to_a_map_of_the_new_kind_is_a_panic(at in 0usize..300, byte: u8, keep in 0usize..300) {
        let mut bytes = D2::small().bytes();
        let at = at % bytes.len();
        bytes[at] = byte;
        let _ = parse(&bytes, DepthMapFormat::OpenMvs);
        bytes.truncate(keep);
        let _ = parse(&bytes, DepthMapFormat::OpenMvs);
    }
}

/// Bytes of values of f32, f64 and u16 in the order of the file.
fn doubles_le(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|x| x.to_le_bytes()).collect()
}

/// A map of 4 x 3 pixels whose pixels differ in each plane, and whose first confidences are 0, 0.5,
/// 0.9 and 0.95; returns the length of its header, too.
fn of_distinct_pixels(kind: &str) -> (Vec<u8>, usize) {
    let old = kind == "DR";
    let mut bytes = kind.as_bytes().to_vec();
    bytes.extend([15, 0]);
    bytes.extend([4u32, 3, 4, 3].iter().flat_map(|side| side.to_le_bytes()));
    bytes.extend(floats_le(&[1.0, 9.0]));
    if !old {
        bytes.extend(floats_le(&[1.0]));
    }
    bytes.extend([1, 0, b'a', 2, 0, 0, 0, 10, 0, 0, 0, 1, 0, 0, 0]);
    bytes.extend(doubles_le(&[
        500.0, 0.0, 1.5, 0.0, 510.0, 1.0, 0.0, 0.0, 1.0,
    ]));
    bytes.extend(doubles_le(&[0.0; 12]));
    let header = bytes.len();
    let confidences = [0.0, 0.5, 0.9, 0.95].into_iter().chain([1.0; 8]);
    if old {
        bytes.extend(floats_le(&(1..13u8).map(f32::from).collect::<Vec<_>>()));
        bytes.extend(floats_le(&(0..36u8).map(f32::from).collect::<Vec<_>>()));
        bytes.extend(floats_le(&confidences.collect::<Vec<_>>()));
    } else {
        // 1.0 and the halves after it.
        bytes.extend((0..12u16).flat_map(|i| (0x3C00 + i).to_le_bytes()));
        bytes.extend((0..24u16).flat_map(u16::to_le_bytes));
        bytes.extend(confidences.map(|c| (c * 255.0f32).round() as u8));
    }
    bytes.extend((0..12u32).flat_map(u32::to_le_bytes));
    (bytes, header)
}

/// OpenMVS fuses every map with the camera of the full image.
#[test]
fn an_enlarged_map_looks_where_it_looked_with_less_confidence() {
    for (kind, widths) in [("DR", [4, 12, 4, 4]), ("D2", [2, 4, 1, 4])] {
        let (bytes, start) = of_distinct_pixels(kind);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth0010.dmap");
        std::fs::write(&path, &bytes).unwrap();
        let map = openmvs::WholeMap::read(&path, [8, 6]).unwrap();
        assert_eq!(
            (map.kind(), map.ids(), map.range()),
            (kind, &[10, 1][..], [1.0, 9.0])
        );
        assert_eq!(map.filled().unwrap(), 1.0);
        let large = map.enlarged([8, 6]).unwrap();
        assert_eq!(large.len(), start + 48 * widths.iter().sum::<usize>());
        let number = |at: usize| u32::from_le_bytes(large[at..at + 4].try_into().unwrap());
        assert_eq!([4, 8, 12, 16].map(number), [8, 6, 8, 6]);
        let double = |i: usize| {
            let at = start - 168 + 8 * i;
            f64::from_le_bytes(large[at..at + 8].try_into().unwrap())
        };
        // The middle of the left half of the image stays there: 2 (1.5 + 0.5) - 0.5.
        let camera = [1000.0, 0.0, 3.5, 0.0, 1020.0, 2.5, 0.0, 0.0, 1.0];
        assert_eq!((0..9).map(double).collect::<Vec<_>>(), camera);
        let (mut at, mut at_before) = (start, start);
        for (plane, width) in widths.into_iter().enumerate() {
            for (x, y) in [(0, 0), (1, 1), (7, 0), (4, 5)] {
                let pixel = &large[at + width * (8 * y + x)..][..width];
                let before = &bytes[at_before + width * (4 * (y / 2) + x / 2)..][..width];
                if plane == 2 {
                    let confidence = |bytes: &[u8]| match *bytes {
                        [byte] => f32::from(byte) / 255.0,
                        _ => f32::from_le_bytes(bytes.try_into().unwrap()),
                    };
                    let wanted = (1.0 - 4.0 * (1.0 - confidence(before))).max(0.0);
                    assert!((confidence(pixel) - wanted).abs() < 0.01, "{kind} {x} {y}");
                } else {
                    assert_eq!(pixel, before, "{kind} plane {plane} {x} {y}");
                }
            }
            (at, at_before) = (at + 48 * width, at_before + 12 * width);
        }
    }
}

#[test]
fn a_map_that_is_cut_off_or_larger_than_its_image_is_not_whole() {
    let (bytes, header) = of_distinct_pixels("D2");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("depth0010.dmap");
    let read = |bytes: &[u8], image| {
        std::fs::write(&path, bytes).unwrap();
        openmvs::WholeMap::read(&path, image).map(|map| map.size())
    };
    // Programs round up.
    assert_eq!(read(&bytes, [3, 2]).unwrap(), [4, 3]);
    for (length, image) in [
        (bytes.len(), [2, 3]),
        (bytes.len() - 1, [4, 3]),
        (header, [4, 3]),
        (header - 1, [4, 3]),
        (3, [4, 3]),
    ] {
        read(&bytes[..length], image).unwrap_err();
    }
}
