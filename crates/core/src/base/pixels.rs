//! Bounds the pixels for which readers of images, masks and depth maps allocate memory.
//!
//! The header of a file of a few kilobytes may claim any size, and deflated pixels shrink a
//! thousandfold. The camera of the view says how many there are.

/// Most pixels of a picture or depth map: those of large-format aerial cameras (20,010 x 13,080).
/// Decoded to 8-bit RGB they take 0.8 GB.
const MOST: u64 = 1 << 28;
/// Longest side: readers hold a few rows besides the pixels.
const LONGEST_SIDE: u32 = 1 << 18;
/// Most bytes of a pixel in the formats of depth maps.
const BYTES_PER_PIXEL: u64 = 8;
/// Most bytes of a header.
const HEADER_BYTES: u64 = 1 << 20;

/// Bytes to which any file may be decoded.
const DECODED: u64 = 1 << 29;
/// Bytes to which each byte of a larger file may be decoded.
const DECODED_PER_BYTE: u64 = 8;

/// Returns the limit on the bytes to which the pixels of a file of this many bytes are decoded.
/// Deflated planes shrink a thousandfold; photographs and depths, whose last bits are noise, hardly
/// to an eighth.
pub const fn most_decoded_bytes(file_bytes: u64) -> u64 {
    let most = file_bytes.saturating_mul(DECODED_PER_BYTE);
    if most > DECODED { most } else { DECODED }
}

/// Pixels of a picture of any bytes.
const OF_ANY_FILE: u64 = 1 << 24;
/// Most pixels of each byte of a larger picture. A baseline JPEG without any detail has fewer
/// (6 bits for 64 pixels of grey), a deflated plane a thousand.
const OF_BYTE: u64 = 256;

/// Returns the most pixels of a photograph whose file has so many bytes.
pub fn most_photographed_pixels(file_bytes: u64) -> u64 {
    OF_ANY_FILE.max(file_bytes.saturating_mul(OF_BYTE))
}

/// Largest number of pixels to read from one file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PixelBound(u64);

/// A picture or depth map with more pixels than its bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{width} x {height} pixels, at most {most} are read here")]
pub struct TooManyPixels {
    pub width: u32,
    pub height: u32,
    /// The bound.
    pub most: u64,
}

impl PixelBound {
    /// The bound where no camera is known.
    pub const LARGEST: Self = Self(MOST);

    /// Bounds by a number of pixels and by [`Self::LARGEST`].
    pub const fn new(pixels: u64) -> Self {
        Self(if pixels < MOST { pixels } else { MOST })
    }

    /// The bound of a photograph whose file has so many bytes.
    pub fn of_photograph(self, bytes: u64) -> Self {
        Self(self.0.min(most_photographed_pixels(bytes)))
    }

    /// The bound, pixels.
    pub const fn pixels(self) -> u64 {
        self.0
    }

    /// Returns the number of pixels of this width and height.
    ///
    /// # Errors
    /// If there are more than the bound.
    pub fn admit(self, width: u32, height: u32) -> Result<usize, TooManyPixels> {
        let pixels = u64::from(width) * u64::from(height);
        if pixels <= self.0 && width.max(height) <= LONGEST_SIDE {
            Ok(pixels as usize)
        } else {
            Err(TooManyPixels {
                width,
                height,
                most: self.0,
            })
        }
    }

    /// Bytes that a depth map within the bound has up to the end of its depths.
    pub const fn file_bytes(self) -> u64 {
        HEADER_BYTES + self.0 * BYTES_PER_PIXEL
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_photographs_are_decoded_and_small_files_not_to_gigabytes() {
        let phase_one = 14_204 * 10_652;
        assert!(most_decoded_bytes(60 << 20) >= 3 * phase_one);
        assert!(most_decoded_bytes(6 * phase_one / 2) >= 6 * phase_one);
        assert!(most_decoded_bytes(64 << 20) < 1_000_000_000);
    }

    #[test]
    fn a_photograph_has_its_bytes_and_a_plane_of_kilobytes_is_none() {
        let of = |bytes: u64| PixelBound::LARGEST.of_photograph(bytes);
        assert!(of(1 << 20).admit(14_204, 10_652).is_ok());
        assert!(of(32_288).admit(18_800, 14_100).is_err());
        assert!(of(500).admit(4096, 4096).is_ok());
        assert_eq!(PixelBound::new(9).of_photograph(1 << 20).pixels(), 9);
    }

    #[test]
    fn sizes_up_to_the_bound_are_admitted() {
        let camera = PixelBound::new(600 * 400);
        assert_eq!(camera.admit(600, 400), Ok(240_000));
        assert_eq!(camera.admit(400, 600), Ok(240_000));
        assert_eq!(
            camera.admit(601, 400),
            Err(TooManyPixels {
                width: 601,
                height: 400,
                most: 240_000
            })
        );
        for bound in [PixelBound::LARGEST, PixelBound::new(u64::MAX)] {
            assert!(
                bound.admit(14_204, 10_652).is_ok(),
                "an aerial camera of 151 megapixels"
            );
            for (width, height) in [
                (124_000, 124_000),
                (u32::MAX, u32::MAX),
                (u32::MAX, 1),
                (1, 1_000_000),
            ] {
                assert!(bound.admit(width, height).is_err(), "{width} x {height}");
            }
        }
    }
}
