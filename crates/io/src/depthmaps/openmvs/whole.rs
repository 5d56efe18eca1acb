//! A map of OpenMVS that is whole, for those who run the program: what it was made from, how much
//! of it is filled, and the same map at a larger size.

use std::{
    fs,
    path::{Path, PathBuf},
};

use viewrank_core::base::pixels::PixelBound;

use super::{HAS_DEPTH, Header, Kind, MATRICES, read_header};
use crate::{
    depthmaps::{DepthMapError, DepthMapFormat, read},
    input::{self, FileKind},
};

/// Bit of the plane of confidences.
const HAS_CONFIDENCE: u8 = 4;
/// Offset of the sizes of image and map, two u32 each.
const SIZES: usize = 4;
/// Offset of the value of a confidence of 255 in `D2`.
const GREATEST_CONFIDENCE: usize = 28;

/// A map whose planes are all there, and which is no larger than its image.
pub struct WholeMap {
    path: PathBuf,
    header: Header,
}

impl Kind {
    fn letters(self) -> &'static str {
        match self {
            Self::Floats => "DR",
            Self::Halves { .. } => "D2",
        }
    }

    /// Bits of the planes in their order, and bytes of a pixel in each: depth, normal, confidence,
    /// views.
    fn planes(self) -> [(u8, usize); 4] {
        let [depth, normal, confidence] = match self {
            Self::Floats => [4, 12, 4],
            Self::Halves { .. } => [2, 4, 1],
        };
        [
            (HAS_DEPTH, depth),
            (2, normal),
            (HAS_CONFIDENCE, confidence),
            (8, 4),
        ]
    }
}

impl WholeMap {
    /// Reads the header. `image`: width and height of the matched image, pixels; programs may round
    /// up.
    ///
    /// # Errors
    /// [`DepthMapError::Newer`], and [`DepthMapError::Format`] for a map that ends too early or is
    /// larger than the image.
    pub fn read(path: &Path, image: [u32; 2]) -> Result<Self, DepthMapError> {
        let whole = Self::read_of_any_size(path)?;
        let [width, height] = whole.size();
        if width > image[0].saturating_add(1) || height > image[1].saturating_add(1) {
            let what = format!("{width} x {height} pixels, more than the image has");
            return Err(DepthMapError::format(path)((SIZES, what)));
        }
        Ok(whole)
    }

    fn read_of_any_size(path: &Path) -> Result<Self, DepthMapError> {
        let whole = Self {
            path: path.into(),
            header: read_header(path)?,
        };
        let [width, height] = whole.size();
        let there = fs::metadata(path).map_err(DepthMapError::io(path))?.len();
        let needed = whole.bytes();
        if width == 0 || height == 0 || there < needed {
            let what = format!("{width} x {height} pixels need {needed} bytes, {there} are there");
            return Err(DepthMapError::format(path)((SIZES, what)));
        }
        Ok(whole)
    }

    /// Returns whether there is a map whose planes are all there.
    pub fn is_there(path: &Path) -> bool {
        Self::read_of_any_size(path).is_ok()
    }

    /// Width and height, pixels.
    pub fn size(&self) -> [u32; 2] {
        [self.header.width, self.header.height]
    }

    /// Letters of the map's kind: OpenMVS joins only maps of one.
    pub fn kind(&self) -> &'static str {
        self.header.kind.letters()
    }

    /// Ids of the key view and of the partners that were used.
    pub fn ids(&self) -> &[u32] {
        &self.header.ids
    }

    /// Least and greatest depth that was searched, scene units.
    pub fn range(&self) -> [f64; 2] {
        self.header.range.map(f64::from)
    }

    /// Share of the pixels that have a depth.
    pub fn filled(&self) -> Result<f64, DepthMapError> {
        let bound = PixelBound::new(self.pixels());
        Ok(read(&self.path, DepthMapFormat::OpenMvs, bound)?.filled())
    }

    /// Returns the bytes of the map with each pixel repeated to a larger size, pixels. Its
    /// confidences fall as those of a match do whose deviation is twice as large, so that a fusion
    /// averages finer maps with four times the weight (`docs/backends.md` 2).
    pub fn enlarged(&self, size: [u32; 2]) -> Result<Vec<u8>, DepthMapError> {
        let bytes = input::read_start(&self.path, FileKind::Picture, self.bytes())
            .map_err(DepthMapError::io(&self.path))?;
        // The program may have replaced the file since its header was read.
        if (bytes.len() as u64) < self.bytes() {
            let what = "the file has become shorter".to_owned();
            return Err(DepthMapError::format(&self.path)((bytes.len(), what)));
        }
        let (head, mut planes) = bytes.split_at(self.header.length);
        let mut enlarged = self.enlarged_head(head, size);
        for (bit, width) in self.present_planes() {
            let (plane, rest) = planes.split_at(width * self.pixels() as usize);
            planes = rest;
            if bit == HAS_CONFIDENCE {
                self.repeat(&self.lowered(head, plane), width, size, &mut enlarged);
            } else {
                self.repeat(plane, width, size, &mut enlarged);
            }
        }
        Ok(enlarged)
    }

    fn pixels(&self) -> u64 {
        u64::from(self.header.width) * u64::from(self.header.height)
    }

    fn present_planes(&self) -> impl Iterator<Item = (u8, usize)> + use<> {
        let planes = self.header.planes;
        let all = self.header.kind.planes().into_iter();
        all.filter(move |(bit, _)| planes & bit != 0)
    }

    /// Bytes of the header and of all planes.
    fn bytes(&self) -> u64 {
        let per_pixel: usize = self.present_planes().map(|(_, width)| width).sum();
        let planes = self.pixels().saturating_mul(per_pixel as u64);
        planes.saturating_add(self.header.length as u64)
    }

    /// Returns the header with other sizes, and the camera matrix that belongs to them.
    fn enlarged_head(&self, head: &[u8], size: [u32; 2]) -> Vec<u8> {
        let mut head = head.to_vec();
        // Of the image as of the map: the fusion takes one size for all.
        for (i, side) in size.into_iter().cycle().take(4).enumerate() {
            let at = SIZES + 4 * i;
            head[at..at + 4].copy_from_slice(&side.to_le_bytes());
        }
        let camera = head.len() - MATRICES;
        for (row, (new, old)) in size.into_iter().zip(self.size()).enumerate() {
            let scale = f64::from(new) / f64::from(old);
            for column in row..3 {
                let at = camera + 8 * (3 * row + column);
                let entry = f64::from_le_bytes(head[at..at + 8].try_into().expect("eight bytes"));
                // Pixel centres are integers.
                let half = if column == 2 { 0.5 } else { 0.0 };
                let scaled = (entry + half) * scale - half;
                head[at..at + 8].copy_from_slice(&scaled.to_le_bytes());
            }
        }
        head
    }

    /// Appends a plane with each pixel repeated; `width`: bytes of a pixel.
    fn repeat(&self, plane: &[u8], width: usize, size: [u32; 2], into: &mut Vec<u8>) {
        let [columns, rows] = self.size().map(|side| side as usize);
        let [wide, high] = size.map(|side| side as usize);
        into.reserve(width * wide * high);
        for y in 0..high {
            let row = &plane[width * columns * (y * rows / high)..];
            for x in 0..wide {
                let at = width * (x * columns / wide);
                into.extend_from_slice(&row[at..at + width]);
            }
        }
    }

    /// Returns a plane of confidences c with 1 - 4 (1 - c) in their place.
    fn lowered(&self, head: &[u8], plane: &[u8]) -> Vec<u8> {
        let lowered = |c: f32| if c > 0.0 { (4.0 * c - 3.0).max(0.0) } else { c };
        match self.header.kind {
            Kind::Floats => {
                let values = plane.as_chunks().0.iter();
                let values = values.map(|four| lowered(f32::from_le_bytes(*four)));
                values.flat_map(f32::to_le_bytes).collect()
            }
            Kind::Halves { .. } => {
                let four = &head[GREATEST_CONFIDENCE..GREATEST_CONFIDENCE + 4];
                let greatest = f32::from_le_bytes(four.try_into().expect("four bytes"));
                let unit = if greatest > 0.0 {
                    greatest / 255.0
                } else {
                    1.0
                };
                let byte = |byte: &u8| (lowered(f32::from(*byte) * unit) / unit).round() as u8;
                plane.iter().map(byte).collect()
            }
        }
    }
}
