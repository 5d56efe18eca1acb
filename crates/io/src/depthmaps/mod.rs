//! Readers for the depth maps of the backends, one module per format, and the assignment of files
//! to views.

pub mod colmap;
mod dmb;
mod exr;
mod find;
mod micmac;
pub mod mve;
mod npy;
pub mod openmvs;
pub mod pfm;
#[cfg(test)]
mod tests;

use std::{
    fs,
    path::{Path, PathBuf},
    time::{Duration, SystemTime},
};

use nalgebra::Point2;
use rayon::prelude::*;
use viewrank_core::{
    base::{
        error::{Advice, Hint},
        pixels::PixelBound,
    },
    model::{
        camera::Camera,
        scene::{Scene, ViewIndex},
    },
};

use crate::input::{self, FileKind};

pub use find::{
    DepthMapFile, DepthMapSet, MICMAC_MARK, default_folders, files_of, files_with_depths, find,
    folder_of, folders, folders_of_others, ids_of, is_of_a_map, list, list_preferring,
};

/// Depth map formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthMapFormat {
    /// `NAME.geometric.bin` in `stereo/depth_maps`.
    ColmapGeometric,
    /// `NAME.photometric.bin` in `stereo/depth_maps`.
    ColmapPhotometric,
    /// `depthNNNN.dmap`.
    OpenMvs,
    /// `NNNNNNNN.pfm` (MVSNet, PatchmatchNet).
    Pfm,
    /// `2333_NNNNNNNN/depths.dmb` (ACMH, ACMM, ACMP, ACMMP).
    Dmb,
    /// `2_TIME_NAME/disp.dmb` (Gipuma).
    Gipuma,
    /// `NAME.mve/depth-LN.mvei` (MVE's dmrecon); holds the length of the ray.
    Mve,
    /// `ID_depthMap.exr` (AliceVision); holds the length of the ray.
    AliceVision,
    /// `MM-Malt-Img-STEM/MMLastNuage.xml` and the images that it names (MicMac), of distorted
    /// images.
    MicMac,
    /// `NAME.npy` (`integrations/sgm`).
    Npy,
}

impl DepthMapFormat {
    /// Returns whether the program stores the distance from the camera's centre instead of z.
    fn holds_ray_length(self) -> bool {
        matches!(self, Self::Mve | Self::AliceVision)
    }

    /// Returns whether the program matches images as they were taken, with their distortion.
    pub fn takes_distorted(self) -> bool {
        self == Self::MicMac
    }
}

/// Depth along the optical axis for each pixel of an image, possibly reduced.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthMap {
    pub format: DepthMapFormat,
    pub width: u32,
    pub height: u32,
    /// z in camera coordinates, scene units; `height` x `width`, row-major; finite, at least 0, 0
    /// for no depth.
    pub depth: Vec<f32>,
    /// Backend ids of the key view and its partners, as stored in the file; empty for formats
    /// without ids.
    pub ids: Vec<u32>,
}

impl DepthMap {
    /// Depth at a map pixel, scene units; `None` without a measurement. Panics outside the map.
    pub fn depth_at(&self, column: u32, row: u32) -> Option<f64> {
        let z = self.depth[row as usize * self.width as usize + column as usize];
        (z > 0.0).then(|| f64::from(z))
    }

    /// Share of the pixels that have a depth.
    pub fn filled(&self) -> f64 {
        let filled = self.depth.iter().filter(|depth| **depth > 0.0).count();
        filled as f64 / self.depth.len() as f64
    }

    /// Size of a map pixel along x and y, in pixels of the camera's image.
    pub fn pixel_size(&self, camera: &Camera) -> (f64, f64) {
        (
            f64::from(camera.width) / f64::from(self.width),
            f64::from(camera.height) / f64::from(self.height),
        )
    }

    /// Centre of a map pixel, in pixels of the camera's image. It is the centre of the matched
    /// patch even for programs that back-project the integer column and row (COLMAP, ACMM).
    pub fn image_position(&self, camera: &Camera, column: u32, row: u32) -> Point2<f64> {
        let (sx, sy) = self.pixel_size(camera);
        Point2::new((f64::from(column) + 0.5) * sx, (f64::from(row) + 0.5) * sy)
    }

    /// Column and row of the map pixel that contains an image position; `None` outside the image.
    pub fn pixel_at(&self, camera: &Camera, position: &Point2<f64>) -> Option<(u32, u32)> {
        let (sx, sy) = self.pixel_size(camera);
        let (x, y) = (position.x / sx, position.y / sy);
        let inside =
            x >= 0.0 && y >= 0.0 && x < f64::from(self.width) && y < f64::from(self.height);
        inside.then_some((x as u32, y as u32))
    }

    /// Depth at an image position, scene units: bilinear interpolation of inverse depth if all four
    /// neighbours have a depth and the result is within `same_surface` (a fraction of the depth) of
    /// the nearest pixel; otherwise the depth of the nearest pixel.
    pub fn interpolated(
        &self,
        camera: &Camera,
        position: &Point2<f64>,
        same_surface: f64,
    ) -> Option<f64> {
        let (column, row) = self.pixel_at(camera, position)?;
        let nearest = self.depth_at(column, row);
        let (sx, sy) = self.pixel_size(camera);
        let (x, y) = (position.x / sx - 0.5, position.y / sy - 0.5);
        let (left, top) = (x.floor(), y.floor());
        let (right, down) = (x - left, y - top);
        // On a plane, inverse depth is linear across the image, which depth is not.
        let inverse = |dx: f64, dy: f64| {
            let (column, row) = (left + dx, top + dy);
            let inside = column >= 0.0
                && row >= 0.0
                && column < f64::from(self.width)
                && row < f64::from(self.height);
            inside
                .then(|| self.depth_at(column as u32, row as u32))
                .flatten()
                .map(f64::recip)
        };
        let corners = [
            (inverse(0.0, 0.0), (1.0 - right) * (1.0 - down)),
            (inverse(1.0, 0.0), right * (1.0 - down)),
            (inverse(0.0, 1.0), (1.0 - right) * down),
            (inverse(1.0, 1.0), right * down),
        ];
        // At a pixel centre the other corners have weight 0 and need no depth.
        let used = corners.iter().filter(|(_, weight)| *weight > 1e-9);
        let depth = used
            .map(|(inverse, weight)| inverse.map(|i| i * weight))
            .sum::<Option<f64>>()
            .map(f64::recip);
        match (depth, nearest) {
            (Some(depth), Some(nearest)) if (depth - nearest).abs() <= same_surface * nearest => {
                Some(depth)
            }
            _ => nearest,
        }
    }

    /// Turns distances from the centre of a pinhole camera into z, for formats that hold those.
    fn along_the_axis(mut self, camera: &Camera) -> Self {
        if self.format.holds_ray_length() {
            let (sx, sy) = self.pixel_size(camera);
            let (f, c) = camera.pinhole_part();
            for (row, depths) in (0..).zip(self.depth.chunks_exact_mut(self.width as usize)) {
                let y = ((f64::from(row) + 0.5) * sy - c.y) / f.y;
                for (column, z) in (0u32..).zip(depths) {
                    let x = ((f64::from(column) + 0.5) * sx - c.x) / f.x;
                    *z = (f64::from(*z) / (1.0 + x * x + y * y).sqrt()) as f32;
                }
            }
        }
        self
    }

    /// Takes out the depths whose confidence, in a file of the same form, is too low.
    fn keep_confident(&mut self, path: &Path) -> Result<(), DepthMapError> {
        let confidence = read(path, self.format, PixelBound::new(self.depth.len() as u64))?;
        if (confidence.width, confidence.height) != (self.width, self.height) {
            let size = |map: &Self| format!("{} x {} pixels", map.width, map.height);
            let what = format!(
                "{}, but the depth map has {}",
                size(&confidence),
                size(self)
            );
            return Err(DepthMapError::format(path)((0, what)));
        }
        for (z, &confidence) in self.depth.iter_mut().zip(&confidence.depth) {
            // Not a number is no confidence either.
            *z = if confidence > LEAST_CONFIDENCE {
                *z
            } else {
                0.0
            };
        }
        Ok(())
    }

    /// Returns whether the map has the aspect ratio of the camera's image, up to rounding of its
    /// size.
    pub fn fits(&self, camera: &Camera) -> bool {
        let (sx, sy) = self.pixel_size(camera);
        let rounding = 1.0 / f64::from(self.width) + 1.0 / f64::from(self.height);
        (sx / sy - 1.0).abs() <= rounding
    }

    /// Returns a map of the same size without any depth.
    pub fn without_depths(&self) -> Self {
        Self {
            depth: vec![0.0; self.depth.len()],
            ids: Vec::new(),
            ..*self
        }
    }
}

/// Error of finding or reading depth maps.
#[derive(Debug, thiserror::Error)]
pub enum DepthMapError {
    #[error("cannot read {path}: {source}")]
    Io {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{path}: byte {byte}: {what}")]
    Format {
        path: PathBuf,
        byte: usize,
        what: String,
    },
    #[error("{path}: {kind}, which is newer than this viewrank")]
    Newer { path: PathBuf, kind: String },
    #[error("{path}: still being written, so it counts as unfinished")]
    Unfinished { path: PathBuf },
    #[error("{path}: still being matched, or failed: there is no {}", file.display())]
    Unmatched { path: PathBuf, file: PathBuf },
    #[error("no depth maps of the plan's views in {0}")]
    None(PathBuf),
    #[error("{path}: {what}")]
    Names { path: PathBuf, what: String },
    #[error("two depth maps of view {view}: {first} and {second}")]
    Duplicate {
        view: String,
        first: PathBuf,
        second: PathBuf,
    },
    #[error("depth maps need undistorted images, but view {view} has a {model} camera")]
    Distorted { view: String, model: &'static str },
    #[error("{}: {} x {} pixels don't have the aspect ratio of {view}, {} x {}", .path.display(), .map[0], .map[1], .image[0], .image[1])]
    Shape {
        path: PathBuf,
        map: [u32; 2],
        view: String,
        image: [u32; 2],
    },
}

impl DepthMapError {
    /// Makes the error of a file that cannot be read.
    fn io(path: &Path) -> impl Fn(std::io::Error) -> Self {
        move |source| Self::Io {
            path: path.into(),
            source,
        }
    }

    /// Makes the error of a file with a fault at a byte, of those that were read. Where the bytes
    /// end too early (see [`Parsed`]) and the file has just changed, a program is writing it.
    fn of_bytes(path: &Path, bytes: &[u8]) -> impl Fn((usize, String)) -> Self {
        let length = bytes.len();
        move |(byte, what)| {
            if byte >= length && has_just_changed(path) {
                return Self::Unfinished { path: path.into() };
            }
            Self::format(path)((byte, what))
        }
    }

    /// Makes the error of a file with a fault at a byte.
    fn format(path: &Path) -> impl Fn((usize, String)) -> Self {
        move |(byte, what)| Self::Format {
            path: path.into(),
            byte,
            what,
        }
    }
}

/// Time after a change in which a file that ends too early is taken for one that is being written.
const BEING_WRITTEN: Duration = Duration::from_secs(180);

fn has_just_changed(path: &Path) -> bool {
    let changed = path.metadata().and_then(|found| found.modified());
    // The clock of another machine may be ahead.
    let age = |time: SystemTime| time.elapsed().unwrap_or_else(|ahead| ahead.duration());
    changed.is_ok_and(|time| age(time) < BEING_WRITTEN)
}

impl Hint for DepthMapError {
    fn hint(&self) -> Option<Advice> {
        let hint = match self {
            Self::Io { .. } => "check that the file exists and is readable",
            Self::Format { .. } => "compute this depth map again, or remove it: it is damaged",
            Self::Unfinished { .. } => "try again when it is finished",
            Self::Newer { .. } => {
                "use a newer viewrank, or compute the depth maps with a version of the program that this viewrank knows (docs/programs.md)"
            }
            Self::Unmatched { .. } => {
                "let the run.sh of the export end: it marks each view that is finished"
            }
            Self::None(_) => {
                "name the folder with COLMAP's stereo/depth_maps, OpenMVS's depthNNNN.dmap, MVSNet's NNNNNNNN.pfm, ACMM's \
                 2333_NNNNNNNN/depths.dmb, Gipuma's 2_TIME_NAME/disp.dmb, MVE's NAME.mve/depth-LN.mvei, AliceVision's ID_depthMap.exr, \
                 MicMac's MM-Malt-Img-NAME/MMLastNuage.xml, or NAME.npy of integrations/sgm"
            }
            Self::Names { .. } => "copy the view_names.txt that `viewrank export` writes",
            Self::Duplicate { .. } => "name a folder with the depth maps of one run",
            Self::Distorted { .. } => {
                "use the undistorted workspace in which the depth maps were made"
            }
            Self::Shape { .. } => "use uncropped depth maps of these images",
        };
        Some(hint.into())
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::Io { path, .. }
            | Self::Format { path, .. }
            | Self::Newer { path, .. }
            | Self::Unfinished { path }
            | Self::Unmatched { path, .. }
            | Self::None(path)
            | Self::Names { path, .. }
            | Self::Shape { path, .. }
            | Self::Duplicate { second: path, .. } => Some(path),
            Self::Distorted { .. } => None,
        }
    }
}

/// A parse result; an error has the byte offset and the problem, the caller adds the path. Bytes
/// that end too early have their fault at the end.
type Parsed<T> = Result<T, (usize, String)>;

/// Width and height of a map, and its values as the file has them, row-major.
type Plane = ([u32; 2], Vec<f32>);

/// Reads another file of a depth map's folder, by its name.
pub type Beside<'a> = &'a dyn Fn(&str) -> std::io::Result<Vec<u8>>;

/// Reads one depth map as the file has it: some formats hold distances from the camera's centre,
/// see [`read_of_view`]. No more of the file is read than a map within the bound has.
pub fn read(
    path: &Path,
    format: DepthMapFormat,
    bound: PixelBound,
) -> Result<DepthMap, DepthMapError> {
    let read = |path: &Path| match format {
        // A description in XML.
        DepthMapFormat::MicMac => input::read(path, FileKind::Settings),
        _ => input::read_start(path, FileKind::Picture, bound.file_bytes()),
    };
    let bytes = read(path).map_err(DepthMapError::io(path))?;
    let beside = |name: &str| {
        input::read_start(
            &path.with_file_name(name),
            FileKind::Picture,
            bound.file_bytes(),
        )
    };
    check_kind(path, format, &bytes)?;
    parse(&bytes, format, bound, &beside).map_err(DepthMapError::of_bytes(path, &bytes))
}

/// Refuses a map of a kind that came after this program: it is as good as any other.
fn check_kind(path: &Path, format: DepthMapFormat, bytes: &[u8]) -> Result<(), DepthMapError> {
    let newer = (format == DepthMapFormat::OpenMvs).then(|| openmvs::newer(bytes));
    newer.flatten().map_or(Ok(()), |kind| {
        Err(DepthMapError::Newer {
            path: path.into(),
            kind,
        })
    })
}

/// Confidence that PatchmatchNet's fusion asks for by default (`--photo_thres`): it drops depths of
/// no more.
const LEAST_CONFIDENCE: f32 = 0.5;

/// Reads the depth map of a view of the scene. PatchmatchNet gives each pixel a depth; those that
/// it has no confidence in count as none.
///
/// # Errors
/// As [`read`], and if the view isn't a pinhole view but the program takes undistorted images, the
/// map doesn't have the aspect ratio of its image, or its confidences cannot be read.
pub fn read_of_view(file: &DepthMapFile, scene: &Scene) -> Result<DepthMap, DepthMapError> {
    let camera = scene.camera_of(file.view);
    let view = || scene.name(file.view).to_string();
    if !(camera.is_pinhole() || file.format.takes_distorted()) {
        return Err(DepthMapError::Distorted {
            view: view(),
            model: camera.model().name(),
        });
    }
    let mut map = read(&file.path, file.format, camera.most_map_pixels())?;
    let confidences = (file.format == DepthMapFormat::Pfm)
        .then(|| confidences_of(&file.path))
        .flatten();
    if let Some(path) = confidences.filter(|path| path.is_file()) {
        map.keep_confident(&path)?;
    }
    if !map.fits(camera) {
        let (map, image) = ([map.width, map.height], [camera.width, camera.height]);
        return Err(DepthMapError::Shape {
            path: file.path.clone(),
            map,
            view: view(),
            image,
        });
    }
    Ok(map.along_the_axis(camera))
}

/// Bytes of the depth maps that are in memory at once.
const AT_ONCE: u64 = 1 << 32;
/// Bytes per pixel of a map while it is compared: its depths, those of a reference, what comes of
/// it, and the surface in front.
const COMPARED_PIXEL: u64 = 22;

/// Maps `work` over items that each read the depth map of a view, in order, in parallel, but on no
/// more at once than fit in [`AT_ONCE`]: a map may be as large as the image of its camera.
pub fn in_parallel<A: Sync, R: Send, E: Send>(
    mut items: &[A],
    view_of: impl Fn(&A) -> Option<ViewIndex>,
    scene: &Scene,
    work: impl Fn(&A) -> Result<R, E> + Sync + Send,
) -> Result<Vec<R>, E> {
    let bytes = |item: &A| {
        let camera = view_of(item).map(|view| scene.camera_of(view));
        camera.map_or(0, |camera| {
            COMPARED_PIXEL * camera.most_map_pixels().pixels()
        })
    };
    let mut results = Vec::with_capacity(items.len());
    while !items.is_empty() {
        let mut left = AT_ONCE;
        let fits = |item: &&A| {
            let rest = left.checked_sub(bytes(item));
            left = rest.unwrap_or_default();
            rest.is_some()
        };
        // A map that takes more by itself is still read, alone.
        let number = items.iter().take_while(fits).count().max(1);
        let (part, rest) = items.split_at(number);
        let done: Result<Vec<R>, E> = part.par_iter().map(&work).collect();
        results.extend(done?);
        items = rest;
    }
    Ok(results)
}

/// Where PatchmatchNet and its relatives write the confidences of a map: `confidence/NNNNNNNN.pfm`
/// beside `depth_est/NNNNNNNN.pfm`.
fn confidences_of(map: &Path) -> Option<PathBuf> {
    let folder = map
        .parent()
        .filter(|folder| folder.ends_with("depth_est"))?;
    Some(folder.with_file_name("confidence").join(map.file_name()?))
}

/// Parses the bytes of one depth map, with depths as the file has them. `beside` reads another file
/// of its folder. Allocates memory for no more pixels than the bound.
pub fn parse(
    bytes: &[u8],
    format: DepthMapFormat,
    bound: PixelBound,
    beside: Beside,
) -> Parsed<DepthMap> {
    let mut ids = Vec::new();
    let ([width, height], mut depth) = match format {
        DepthMapFormat::ColmapGeometric | DepthMapFormat::ColmapPhotometric => {
            colmap::parse(bytes, bound)
        }
        DepthMapFormat::OpenMvs => openmvs::parse(bytes, bound, &mut ids),
        DepthMapFormat::Pfm => pfm::parse(bytes, bound),
        DepthMapFormat::Dmb | DepthMapFormat::Gipuma => dmb::parse(bytes, bound),
        DepthMapFormat::Mve => mve::parse(bytes, bound),
        DepthMapFormat::AliceVision => exr::parse(bytes, bound),
        DepthMapFormat::MicMac => micmac::parse(bytes, bound, beside),
        DepthMapFormat::Npy => npy::parse(bytes, bound),
    }?;
    // No depth is -1 in AliceVision, 0 or NaN elsewhere.
    for z in &mut depth {
        if !(z.is_finite() && *z > 0.0) {
            *z = 0.0;
        }
    }
    Ok(DepthMap {
        format,
        width,
        height,
        depth,
        ids,
    })
}

/// Returns the number of pixels of a map, which every reader needs before it allocates: at least
/// one and within the bound.
fn pixels(width: u32, height: u32, bound: PixelBound) -> Parsed<usize> {
    match bound.admit(width, height) {
        Ok(0) => Err((0, "the map has no pixels".into())),
        admitted => admitted.map_err(|error| (0, error.to_string())),
    }
}

/// Width and height of a map of little-endian f32 that is all there, by its head: the first
/// `longest` bytes or less, of which `head` returns the size and the offset of the values.
fn whole_size_by(
    path: &Path,
    longest: u64,
    channels: u32,
    head: impl Fn(&[u8]) -> Parsed<([u32; 2], usize)>,
) -> Result<[u32; 2], DepthMapError> {
    let start = input::read_start(path, FileKind::Picture, longest);
    let start = start.map_err(DepthMapError::io(path))?;
    let there = fs::metadata(path).map_err(DepthMapError::io(path))?.len();
    let (size, at) = head(&start).map_err(DepthMapError::format(path))?;
    let [width, height] = size;
    let values = u64::from(width) * u64::from(height);
    let needed = values.saturating_mul(4 * u64::from(channels));
    let needed = needed.saturating_add(at as u64);
    if values > 0 && there == needed {
        return Ok(size);
    }
    let what = format!("{width} x {height} pixels need {needed} bytes, {there} are there");
    Err(DepthMapError::format(path)((at, what)))
}

/// Returns `width` x `height` values of N bytes each from `start`; checks that they are there.
fn plane<const N: usize>(
    bytes: &[u8],
    start: usize,
    [width, height]: [u32; 2],
    bound: PixelBound,
) -> Parsed<impl Iterator<Item = [u8; N]>> {
    let needed = pixels(width, height, bound)? * N;
    let values = bytes.get(start..).unwrap_or_default();
    match values.get(..needed) {
        Some(values) => Ok(values.as_chunks().0.iter().copied()),
        None => Err((
            bytes.len(),
            format!(
                "{width} x {height} pixels need {needed} bytes, {} are left",
                values.len()
            ),
        )),
    }
}

/// Reads a map of this size of little-endian f32 from `start`.
fn floats(bytes: &[u8], start: usize, size: [u32; 2], bound: PixelBound) -> Parsed<Plane> {
    let values = plane(bytes, start, size, bound)?.map(f32::from_le_bytes);
    Ok((size, values.collect()))
}

/// Reads the little-endian u32 at a byte offset.
fn u32_at(bytes: &[u8], at: usize) -> Parsed<u32> {
    let four = at.checked_add(4).and_then(|end| bytes.get(at..end));
    let early = || {
        let what = format!("unexpected end of file, expected 4 bytes at byte {at}");
        (bytes.len(), what)
    };
    let four = four.ok_or_else(early)?;
    Ok(u32::from_le_bytes([four[0], four[1], four[2], four[3]]))
}
