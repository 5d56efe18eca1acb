//! Fuzz targets of what `evaluate`, `train`, `predict` and `export` read beside a model: depth
//! maps, pictures, manifests and settings. None may panic, and what is accepted must be consistent.

use std::path::Path;

use viewrank::{
    Hint,
    backends::canonical_name,
    config::{CommandLineSettings, Configuration, Files},
    manifest,
};
use viewrank_core::base::pixels::PixelBound;
use viewrank_io::{
    depthmaps::{DepthMapFormat, parse},
    image::{self, Image},
};

/// Targets with valid contents.
pub const INPUTS: [(&str, &[u8]); 16] = [
    (
        "map.geometric.bin",
        include_bytes!("../fixtures/depthmaps/depth_maps/IMG_9394.jpg.geometric.bin"),
    ),
    (
        "map.pfm",
        include_bytes!("../fixtures/depthmaps/00000003.pfm"),
    ),
    (
        "map.npy",
        include_bytes!("../fixtures/depthmaps/IMG_9394.jpg.npy"),
    ),
    ("map.dmb", DMB),
    (
        "map.mvei",
        include_bytes!("../fixtures/depthmaps/view_00000068.mve/depth-L3.mvei"),
    ),
    (
        "map.exr",
        include_bytes!("../fixtures/depthmaps/40_depthMap.exr"),
    ),
    ("map.nuage.xml", CLOUD),
    ("map.nuage.depth.tif", DEPTH_IMAGE),
    ("map.nuage.mask.tif", MASK),
    (
        "map.dmap",
        include_bytes!("../fixtures/depthmaps/depth0040.dmap"),
    ),
    (
        "baseline.jpg",
        include_bytes!("../fixtures/pictures/baseline.jpg"),
    ),
    (
        "progressive.jpg",
        include_bytes!("../fixtures/pictures/progressive.jpg"),
    ),
    ("cmyk.jpg", include_bytes!("../fixtures/pictures/cmyk.jpg")),
    (
        "grey_16_bit.png",
        include_bytes!("../fixtures/pictures/grey_16_bit.png"),
    ),
    ("manifest.json", MANIFEST),
    ("viewrank.toml", SETTINGS),
];

/// A cloud of MicMac and the images that it describes.
const CLOUD: &[u8] = include_bytes!("../fixtures/depthmaps/MM-Malt-Img-IMG_9394/MMLastNuage.xml");
const DEPTH_IMAGE: &[u8] =
    include_bytes!("../fixtures/depthmaps/MM-Malt-Img-IMG_9394/Z_Num8_DeZoom1_STD-MALT.tif");
const MASK: &[u8] =
    include_bytes!("../fixtures/depthmaps/MM-Malt-Img-IMG_9394/AutoMask_STD-MALT_Num_7.tif");

/// 2 x 1 depths: type 1, height 1, width 2, 1 channel.
const DMB: &[u8] = b"\x01\0\0\0\x01\0\0\0\x02\0\0\0\x01\0\0\0\0\0\x80\x3f\0\0\0\x40";

const SETTINGS: &[u8] =
    b"image_scale = 0.5\nbackends = [\"colmap\"]\n[target]\ngsd = 0.1\n[cut]\ntarget = \"80%\"\n[surface]\nup = [0, 0, 1]\n[confidence]\nsource = \"none\"\n";

/// Two clusters of two views.
const MANIFEST: &[u8] =
    br#"{"version":2,"input":{"model":"sparse/0","fingerprint":"f"},"backend":"sgm","settings":{"image_scale":0.5},
"clusters":[{"rank":1,"key":"a","partners":["b"],"gain":0.5,"fulfilment":0.5,"share":0.5,"finished":true},
{"rank":2,"key":"b","partners":["a"],"gain":0.25,"fulfilment":0.75,"share":1,"finished":false}],
"cut":{"clusters":1,"pairs":1,"share":0.5,"fulfilment":0.5},
"views":[{"name":"a","status":"key","reason":null},{"name":"b","status":"partner","reason":"no_gain_left"}],
"outdated":[],"exports":[],"warnings":[]}"#;

/// True for targets of JSON, which have values to change as well as bytes.
pub fn is_json(target: &str) -> bool {
    target == "manifest.json"
}

/// Reads `data` as the target is read; true if it is accepted.
pub fn read_input(target: &str, data: &[u8]) -> bool {
    match target {
        "manifest.json" => told(manifest::validate(data, Path::new(target))),
        "viewrank.toml" => read_settings(data),
        _ if target.starts_with("map.") => read_map(target, data),
        _ => read_picture(data),
    }
}

/// Errors must have something to say.
fn told<T>(result: Result<T, impl Hint>) -> bool {
    result
        .inspect_err(|error| assert!(!error.to_string().is_empty()))
        .is_ok()
}

fn read_map(target: &str, data: &[u8]) -> bool {
    let format = match target {
        "map.geometric.bin" => DepthMapFormat::ColmapGeometric,
        "map.pfm" => DepthMapFormat::Pfm,
        "map.npy" => DepthMapFormat::Npy,
        "map.dmb" => DepthMapFormat::Dmb,
        "map.mvei" => DepthMapFormat::Mve,
        "map.exr" => DepthMapFormat::AliceVision,
        _ if target.starts_with("map.nuage.") => DepthMapFormat::MicMac,
        _ => DepthMapFormat::OpenMvs,
    };
    let file = |name: &str, there| if name == target { data } else { there };
    let beside = |name: &str| {
        let is_mask = name.contains("Mask");
        Ok(if is_mask {
            file("map.nuage.mask.tif", MASK)
        } else {
            file("map.nuage.depth.tif", DEPTH_IMAGE)
        }
        .to_vec())
    };
    let described = if target.ends_with(".tif") {
        CLOUD
    } else {
        data
    };
    let Ok(map) = parse(described, format, PixelBound::LARGEST, &beside) else {
        return false;
    };
    assert_eq!(map.depth.len(), map.width as usize * map.height as usize);
    assert!(map.depth.iter().all(|z| z.is_finite() && *z >= 0.0));
    true
}

fn read_picture(data: &[u8]) -> bool {
    let half = |[width, height]: [u32; 2]| [width.div_ceil(2), height.div_ceil(2)];
    if let Ok(mask) = image::mask(data, PixelBound::LARGEST) {
        assert!((0.0..=1.0).contains(&mask.share([3, 2], 2, 1)));
    }
    let grey = Image::decode_grey(data, PixelBound::LARGEST, half);
    if let Ok((grey, full)) = &grey {
        assert_eq!(
            ([grey.width, grey.height], grey.pixels.len()),
            (half(*full), (grey.width * grey.height) as usize)
        );
    }
    let Ok(image) = Image::decode(data, PixelBound::LARGEST, half) else {
        return false;
    };
    assert_eq!(
        image.rgb.len(),
        3 * image.width as usize * image.height as usize
    );
    grey.is_ok()
}

fn read_settings(data: &[u8]) -> bool {
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    std::fs::write(file.path(), data).expect("a temporary file");
    let files = Files {
        user: None,
        root: None,
        project: Some(file.path().into()),
    };
    let Ok(configuration) =
        Configuration::load(&files, CommandLineSettings::default(), canonical_name)
    else {
        return false;
    };
    configuration
        .settings
        .check()
        .expect("what is read is within its ranges");
    true
}
