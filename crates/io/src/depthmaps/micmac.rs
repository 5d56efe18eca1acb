//! MicMac's `Malt GeomImage`: `MM-Malt-Img-STEM/MMLastNuage.xml` describes the depth image of the
//! last step and its mask, two TIFF files beside it.
//!
//! ```text
//! XML_ParamNuage3DMaille    NbPixel, PN3M_Nuage/Image_Profondeur, Orientation/Externe, PM3D_ParamSpecifs/ModeFaisceauxImage
//! Image_Profondeur    Image, Masq, OrigineAlti, ResolutionAlti, GeomRestit
//! ModeFaisceauxImage    DirFaisceaux, ZIsInverse, IsSpherik
//! ```
//!
//! With v of the depth image (f32), r = OrigineAlti + v ResolutionAlti is 1 / z if ZIsInverse, else
//! z, along DirFaisceaux: by default the optical axis, the third column of the rotation from camera
//! to world. Every pixel has a value; the 1-bit mask marks the valid ones. Maps are in the geometry
//! of the original, distorted image. With ZoomF = d, pixel x of the map is centred on pixel d x of
//! the image, which is (d - 1) / 2 pixels off what is assumed here. Read in the source (f8fe432),
//! not run.

use std::io::Cursor;

use tiff::{
    ColorType,
    decoder::{Decoder, DecodingResult, Limits},
};
use viewrank_core::base::pixels::PixelBound;

use super::{Beside, Parsed, Plane, pixels};
use crate::{
    formats::{
        Fault, Place, Problem,
        xml::{Element, Xml},
    },
    picture,
};

/// Distance from 1 of the product of DirFaisceaux, a unit vector, and the optical axis from which
/// they differ.
const SAME_DIRECTION: f64 = 1e-6;

/// The part of `MMLastNuage.xml` from which depths are computed.
struct Cloud {
    size: [u32; 2],
    /// Names of the depth image and of its mask.
    image: String,
    mask: String,
    origin: f64,
    resolution: f64,
    is_inverse: bool,
}

pub(super) fn parse(bytes: &[u8], bound: PixelBound, beside: Beside) -> Parsed<Plane> {
    let cloud = cloud(bytes)?;
    let [width, height] = cloud.size;
    let pixels = pixels(width, height, bound)?;
    let (values, mask) = (depth_image(&cloud, beside)?, mask(&cloud, beside)?);
    if [values.len(), mask.len()] != [pixels; 2] {
        return Err((
            0,
            format!(
                "{} and {}: expected {pixels} pixels",
                cloud.image, cloud.mask
            ),
        ));
    }
    let z = |(v, is_depth): (f32, bool)| {
        let r = cloud.origin + cloud.resolution * f64::from(v);
        let z = if cloud.is_inverse { 1.0 / r } else { r };
        if is_depth { z as f32 } else { 0.0 }
    };
    Ok((cloud.size, values.into_iter().zip(mask).map(z).collect()))
}

/// Returns the names of the depth image and of its mask. MicMac writes the description before it
/// matches.
pub(super) fn files(bytes: &[u8]) -> Parsed<[String; 2]> {
    cloud(bytes).map(|cloud| [cloud.image, cloud.mask])
}

fn cloud(bytes: &[u8]) -> Parsed<Cloud> {
    let root = root(bytes).map_err(fault)?;
    let image = within(&root, ["PN3M_Nuage", "Image_Profondeur"])?;
    let rays = within(&root, ["PM3D_ParamSpecifs", "ModeFaisceauxImage"])?;
    let geometry = text(image, "GeomRestit")?;
    let is_spherical = rays.child("IsSpherik").is_some_and(|e| e.text() == "true");
    if is_spherical || !geometry.starts_with("eGeomMNTFaisceauIm1PrCh_Px") {
        return Err((
            0,
            format!(
                "{geometry} with IsSpherik {is_spherical}: only depths in the rays of an image are read"
            ),
        ));
    }
    let matrix = within(
        &root,
        ["Orientation", "Externe", "ParamRotation", "CodageMatr"],
    )?;
    let direction = numbers::<3>(rays, "DirFaisceaux")?;
    let mut cosine = 0.0;
    for (row, x) in ["L1", "L2", "L3"].into_iter().zip(direction) {
        // The third column is the optical axis in the world.
        cosine += numbers::<3>(matrix, row)?[2] * x;
    }
    // NaN would pass the comparison.
    if cosine.is_nan() || (cosine - 1.0).abs() > SAME_DIRECTION {
        return Err((
            0,
            "depths along another direction than the optical axis: match without Repere=".into(),
        ));
    }
    let [origin, resolution] = image
        .required(["OrigineAlti", "ResolutionAlti"])
        .map_err(fault)?;
    Ok(Cloud {
        size: numbers::<2>(&root, "NbPixel")?.map(|side| side as u32),
        image: file_name(image, "Image")?,
        mask: file_name(image, "Masq")?,
        origin,
        resolution,
        is_inverse: text(rays, "ZIsInverse")? == "true",
    })
}

fn root(bytes: &[u8]) -> Result<Element, Fault> {
    let mut xml = Xml::new(bytes)?;
    let found = match xml.enter()? {
        Some(root) if root.name == "XML_ParamNuage3DMaille" => return xml.whole(root),
        found => found.map_or("nothing".into(), |root| format!("<{}>", root.name)),
    };
    Err(Problem::syntax("<XML_ParamNuage3DMaille> of MicMac", found).at(Place::File))
}

fn fault(fault: Fault) -> (usize, String) {
    let byte = if let Place::Byte(byte) = fault.place {
        byte as usize
    } else {
        0
    };
    (byte, fault.problem.to_string())
}

fn within<'a, const N: usize>(
    mut element: &'a Element,
    path: [&'static str; N],
) -> Parsed<&'a Element> {
    for name in path {
        element = element
            .child(name)
            .ok_or_else(|| fault(element.lacks(name)))?;
    }
    Ok(element)
}

fn text<'a>(element: &'a Element, child: &'static str) -> Parsed<&'a str> {
    within(element, [child]).map(Element::text)
}

fn numbers<const N: usize>(element: &Element, child: &'static str) -> Parsed<[f64; N]> {
    within(element, [child])?.numbers().map_err(fault)
}

/// The name of a file beside the description, whose folder may be a stranger's.
fn file_name(element: &Element, child: &'static str) -> Parsed<String> {
    match text(element, child)? {
        name if name.is_empty() || name.contains(['/', '\\']) || name == ".." => Err((
            0,
            format!("<{child}> {name:?}, expected the name of a file in the same folder"),
        )),
        name => Ok(name.into()),
    }
}

/// Returns v of each pixel, row-major.
fn depth_image(cloud: &Cloud, beside: Beside) -> Parsed<Vec<f32>> {
    let name = &cloud.image;
    match decoded(name, cloud.size, 32, beside)? {
        (DecodingResult::F32(values), ColorType::Gray(32)) => Ok(values),
        _ => Err((
            0,
            format!(
                "{name}: expected samples of 32-bit floats: it is that of an earlier step or still being computed"
            ),
        )),
    }
}

/// Returns whether each pixel has a depth, row-major.
fn mask(cloud: &Cloud, beside: Beside) -> Parsed<Vec<bool>> {
    let name = &cloud.mask;
    let [width, height] = cloud.size.map(|side| side as usize);
    match decoded(name, cloud.size, 1, beside)? {
        // Rows of whole bytes, the first pixel in the highest bit.
        (DecodingResult::U8(rows), ColorType::Gray(1)) => {
            let bit = |row: &[u8], x: usize| row[x / 8] >> (7 - x % 8) & 1 == 1;
            let rows = rows.chunks_exact(width.div_ceil(8)).take(height);
            Ok(rows
                .flat_map(|row| (0..width).map(move |x| bit(row, x)))
                .collect())
        }
        (DecodingResult::U8(values), ColorType::Gray(8)) => {
            Ok(values.into_iter().map(|value| value != 0).collect())
        }
        (_, kind) => Err((
            0,
            format!("{name}: {kind:?}, expected a mask of 1 or 8 bits"),
        )),
    }
}

/// Decodes an uncompressed TIFF with one sample per pixel, of at least `bits` bits.
fn decoded(
    name: &str,
    size: [u32; 2],
    bits: u64,
    beside: Beside,
) -> Parsed<(DecodingResult, ColorType)> {
    let fault = |what: String| (0, format!("{name}: {what}"));
    let broken = |error: tiff::TiffError| fault(error.to_string());
    let bytes = beside(name).map_err(|error| fault(error.to_string()))?;
    let length = bytes.len() as u64;
    picture::refuse_many_strips(&mut Cursor::new(&bytes))
        .map_err(|error| fault(error.to_string()))?;
    let mut decoder = Decoder::new(Cursor::new(bytes)).map_err(broken)?;
    let (width, height) = decoder.dimensions().map_err(broken)?;
    if [width, height] != size {
        return Err(fault(format!(
            "{width} x {height} pixels, expected {} x {}",
            size[0], size[1]
        )));
    }
    // MicMac doesn't compress them, so what is decoded is no larger than the file.
    let pixels = u64::from(width) * u64::from(height);
    if pixels == 0 || pixels.saturating_mul(bits) / 8 > length {
        return Err(fault(format!(
            "{width} x {height} pixels are more than its {length} bytes hold"
        )));
    }
    if picture::is_tiff_of_jpegs(&mut decoder).map_err(broken)? {
        return Err(fault(
            "JPEG compression, which MicMac does not write".into(),
        ));
    }
    let mut limits = Limits::default();
    limits.decoding_buffer_size = length.saturating_add(1 << 20) as usize;
    decoder = decoder.with_limits(limits);
    let kind = decoder.colortype().map_err(broken)?;
    Ok((decoder.read_image().map_err(broken)?, kind))
}
