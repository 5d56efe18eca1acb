//! Resizes pictures of 8 bits per channel.

use fast_image_resize::{
    PixelTrait, PixelType, ResizeAlg, ResizeOptions, Resizer,
    images::Image,
    pixels::{U8, U8x3},
};

pub use fast_image_resize::FilterType;

/// Returns the values of a picture of `from` (width, height), resized to `to`; row by row, with
/// `channels` (1 or 3) values per pixel. The filter is as wide as the reduction.
///
/// # Panics
/// If there are not as many values as the size says.
pub fn resized(
    values: Vec<u8>,
    from: [u32; 2],
    to: [u32; 2],
    channels: usize,
    filter: FilterType,
) -> Vec<u8> {
    // By the kind of pixel: the untyped call compiles the code of all 13 kinds.
    if channels == 1 {
        of_kind::<U8>(values, from, to, PixelType::U8, filter)
    } else {
        of_kind::<U8x3>(values, from, to, PixelType::U8x3, filter)
    }
}

fn of_kind<P: PixelTrait>(
    values: Vec<u8>,
    from: [u32; 2],
    to: [u32; 2],
    kind: PixelType,
    filter: FilterType,
) -> Vec<u8> {
    let same = "the kind of pixels is the same";
    let from = Image::from_vec_u8(from[0], from[1], values, kind)
        .expect("as many values as the size and the kind of pixels ask for");
    let mut to = Image::new(to[0], to[1], kind);
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(filter));
    Resizer::new()
        .resize_typed::<P>(
            &from.typed_image().expect(same),
            &mut to.typed_image_mut().expect(same),
            &options,
        )
        .expect("the whole picture is resized");
    to.into_vec()
}
