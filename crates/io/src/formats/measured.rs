//! The sparse points of Bundler and VisualSFM: position, colour, number of observations, then
//! camera, key, x and y of each.

use std::borrow::Cow;

use super::{
    Fault, Problem,
    colmap::{ColmapPoint, Point2d, TrackElement},
    words::Words,
};

/// Points, with pixels as in the file until the sizes of the images are known: from the corner or
/// the centre, y down or up.
pub(super) struct MeasuredPoints {
    pub points: Vec<ColmapPoint<'static>>,
    /// By camera, in the order of the points.
    points2d: Vec<Vec<Point2d>>,
}

impl MeasuredPoints {
    /// Reads `count` points. `is_registered`: for each camera; the others' observations are
    /// dropped. The image of a camera has the id [`image_id`].
    pub fn read(
        words: &mut Words,
        count: usize,
        is_registered: &[bool],
        colour: impl Fn(&mut Words) -> Result<[u8; 3], Fault>,
    ) -> Result<Self, Fault> {
        let mut points2d = vec![Vec::new(); is_registered.len()];
        let mut id = 0;
        let points = words.records("point", count, |words| {
            id += 1;
            Ok(ColmapPoint {
                id,
                at: words.place(),
                xyz: words.numbers("a position")?,
                colour: colour(words)?,
                error: -1.0,
                track: Cow::Owned(track(words, id, is_registered, &mut points2d)?),
            })
        })?;
        Ok(Self { points, points2d })
    }

    /// Returns whether any coordinate is negative, and so from the image centre.
    pub fn are_from_centre(&self) -> bool {
        let mut pixels = self.points2d.iter().flatten().map(Point2d::pixel);
        pixels.any(|[x, y]| x < 0.0 || y < 0.0)
    }

    /// The largest coordinate along each axis, absolute, in the image of a camera.
    pub fn farthest(&self, camera: usize) -> [f64; 2] {
        let pixels = self.points2d[camera].iter().map(Point2d::pixel);
        pixels.fold([0.0, 0.0], |[farthest_x, farthest_y], [x, y]| {
            [x.abs().max(farthest_x), y.abs().max(farthest_y)]
        })
    }

    /// Takes the 2D points of a camera's image, with pixels as `from_corner` makes them.
    pub fn take_points2d(
        &mut self,
        camera: usize,
        from_corner: impl Fn([f64; 2]) -> [f64; 2],
    ) -> Cow<'static, [Point2d]> {
        let mut points2d = std::mem::take(&mut self.points2d[camera]);
        for point2d in &mut points2d {
            *point2d = Point2d::new(from_corner(point2d.pixel()), point2d.point());
        }
        Cow::Owned(points2d)
    }
}

/// The id of the image of a camera, and of the camera itself.
pub(super) fn image_id(camera: usize) -> u32 {
    camera as u32 + 1
}

/// Parses the observations of a point. The key is dropped.
fn track(
    words: &mut Words,
    point: u64,
    is_registered: &[bool],
    points2d: &mut [Vec<Point2d>],
) -> Result<Vec<TrackElement>, Fault> {
    // Four numbers of one digit, each with a separator.
    let count = words.count("observations", 8)?;
    let mut track = Vec::with_capacity(count);
    for _ in 0..count {
        let camera: usize = words.number("a camera")?;
        let _key: i64 = words.number("a key")?;
        let pixel = words.numbers("x and y")?;
        let Some(&is_registered) = is_registered.get(camera) else {
            return Err(words.fault(Problem::absent("camera", camera as u64)));
        };
        if is_registered {
            let points2d = &mut points2d[camera];
            track.push(TrackElement::new(image_id(camera), points2d.len() as u32));
            points2d.push(Point2d::new(pixel, Some(point)));
        }
    }
    Ok(track)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str, count: usize, is_registered: &[bool]) -> MeasuredPoints {
        let colour = |words: &mut Words| Ok(words.numbers("a colour")?.map(|c: f64| c as u8));
        MeasuredPoints::read(
            &mut Words::new(text.as_bytes()),
            count,
            is_registered,
            colour,
        )
        .unwrap()
    }

    #[test]
    fn points_take_no_more_memory_than_their_list_and_their_observations() {
        let read = read(&"1 2 3 4 5 6 0\n".repeat(1000), 1000, &[true; 2]);
        assert_eq!(read.points.capacity(), 1000);
        assert!(read.points2d.iter().all(|points| points.capacity() == 0));
        let allocated = |point: &ColmapPoint| match &point.track {
            Cow::Owned(track) => track.capacity(),
            Cow::Borrowed(_) => 0,
        };
        assert_eq!(read.points.iter().map(allocated).sum::<usize>(), 0);
    }

    #[test]
    fn observations_of_cameras_without_an_image_are_dropped() {
        let text = "0 0 0 0 0 0 3 0 7 -5 4 1 7 9 9 2 7 1 -2\n0 0 0 0 0 0 1 2 7 3 3\n";
        let mut read = read(text, 2, &[true, false, true]);
        assert!(read.are_from_centre());
        assert_eq!(
            [0, 1, 2].map(|camera| read.farthest(camera)),
            [[5.0, 4.0], [0.0; 2], [3.0, 3.0]]
        );
        let tracks: Vec<&[TrackElement]> = read.points.iter().map(|p| &*p.track).collect();
        let element = |camera, index| TrackElement::new(image_id(camera), index);
        assert_eq!(tracks[0], [element(0, 0), element(2, 0)]);
        assert_eq!(tracks[1], [element(2, 1)]);
        let points2d = read.take_points2d(2, |[x, y]| [10.0 + x, 10.0 - y]);
        assert_eq!(
            *points2d,
            [
                Point2d::new([11.0, 12.0], Some(1)),
                Point2d::new([13.0, 7.0], Some(2))
            ]
        );
    }
}
