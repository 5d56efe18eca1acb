//! OpenMVS's `scene.mvs` in its interface form ("MVSI", versions 1 to 7), as libs/MVS/Interface.h defines it.
//!
//! Little-endian, no padding; `str` = u64 length and bytes, `arr(T)` = u64 count and elements, matrices row by row in f64:
//!
//! ```text
//! header    "MVSI"  u32 version  u32 0
//! scene     arr(platform) arr(image) arr(vertex) arr(normal) arr(colour)
//!           v>0: arr(line) arr(normal) arr(colour)   v>1: f64[16] transform   v>5: f64[9] f64[3] f64[3] region of interest
//! platform  str name  arr(camera)  arr(pose)
//! camera    str name  [v>3: str band]  [v>0: u32 width u32 height]  f64[9] K  f64[9] R  f64[3] C
//! pose      f64[9] R  f64[3] C
//! image     str name  [v>4: str mask]  u32 platform u32 camera u32 pose  [v>2: u32 ID]
//!           [v>6: f32 min depth, mean, max  arr(view score)]
//! view score  u32 index  u32 points  f32 scale  f32 angle  f32 area  f32 score
//! vertex    f32[3] X  arr(view)     view := u32 image index  f32 confidence
//! line      f32[3] f32[3] arr(view)     normal := f32[3]     colour := u8[3] blue green red
//! ```
//!
//! Pixel centres are integers: cx is COLMAP's minus 0.5. World to camera: `x = R (X - C)`; a camera's R and C are relative to its
//! platform's pose. There are no measured pixels.

mod scene;

use nom::{
    IResult, Parser,
    bytes::complete::take,
    multi::fill,
    number::complete::{le_f32, le_f64, le_u8, le_u32, le_u64},
};

use super::{Fault, Place, Problem};

/// The pose index of an image that is not calibrated.
pub const NO_POSE: u32 = u32::MAX;

/// The ID of an image that has none: its index counts.
pub const NO_ID: u32 = u32::MAX;

/// The highest version that is understood.
pub const NEWEST: u32 = 7;

/// Everything that the file holds; what a version lacks has its default.
#[derive(Clone, Debug, PartialEq)]
pub struct Mvs {
    pub version: u32,
    pub platforms: Vec<Platform>,
    pub images: Vec<Image>,
    pub vertices: Vec<Vertex>,
    pub normals: Vec<[f32; 3]>,
    /// Blue, green, red.
    pub colours: Vec<[u8; 3]>,
    pub lines: Vec<Line>,
    pub line_normals: Vec<[f32; 3]>,
    pub line_colours: Vec<[u8; 3]>,
    /// Row by row; stored, never applied by OpenMVS.
    pub transform: [f64; 16],
    /// Rotation, least and greatest corner; no region where the corners are not in order.
    pub region: [f64; 15],
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Platform {
    pub name: Vec<u8>,
    pub cameras: Vec<Camera>,
    pub poses: Vec<Pose>,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Camera {
    pub name: Vec<u8>,
    pub band: Vec<u8>,
    /// 0 where K is normalised by the larger side.
    pub width: u32,
    pub height: u32,
    pub k: [f64; 9],
    pub r: [f64; 9],
    pub c: [f64; 3],
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pose {
    pub r: [f64; 9],
    pub c: [f64; 3],
}

#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Path of the image file, relative to OpenMVS's working folder or absolute.
    pub name: Vec<u8>,
    pub mask: Vec<u8>,
    pub platform: u32,
    pub camera: u32,
    /// [`NO_POSE`] where not calibrated.
    pub pose: u32,
    /// Names the depth map's file; the index where the file has none (before version 3, or [`NO_ID`]).
    pub id: u32,
    /// Least, mean and greatest depth.
    pub depths: [f32; 3],
    pub view_scores: Vec<ViewScore>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewScore {
    /// Index of the neighbour in the list of images.
    pub index: u32,
    pub points: u32,
    pub scale: f32,
    /// Radians.
    pub angle: f32,
    pub area: f32,
    pub score: f32,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Vertex {
    pub x: [f32; 3],
    pub views: Vec<VertexView>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VertexView {
    /// Index in the list of images.
    pub image: u32,
    pub confidence: f32,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    pub ends: [[f32; 3]; 2],
    pub views: Vec<VertexView>,
}

impl Default for Mvs {
    /// An empty scene of the newest version, without transform or region.
    fn default() -> Self {
        let mut transform = [0.0; 16];
        (0..4).for_each(|i| transform[5 * i] = 1.0);
        let mut region = [0.0; 15];
        (0..3).for_each(|i| region[4 * i] = 1.0);
        region[9..12].fill(f64::from(f32::MAX));
        region[12..].fill(-f64::from(f32::MAX));
        Self {
            version: NEWEST,
            platforms: Vec::new(),
            images: Vec::new(),
            vertices: Vec::new(),
            normals: Vec::new(),
            colours: Vec::new(),
            lines: Vec::new(),
            line_normals: Vec::new(),
            line_colours: Vec::new(),
            transform,
            region,
        }
    }
}

impl Mvs {
    /// Reads a scene; all indices in it are valid afterwards.
    pub fn read(bytes: &[u8]) -> Result<Self, Fault> {
        let mut reader = Reader { all: bytes.len(), rest: bytes, version: 0 };
        if bytes.get(..4) != Some(b"MVSI") {
            return Err(Fault::new("", Place::Byte(0), foreign(bytes)));
        }
        reader.u32("the header")?;
        reader.version = reader.u32("the header")?;
        if !(1..=NEWEST).contains(&reader.version) {
            let what = format!("interface version {}, and versions 1 to {NEWEST} are read", reader.version);
            let hint = "Write the scene with an OpenMVS from v1.0 to v2.3.";
            return Err(Fault::new("", Place::Byte(4), Problem::Unsupported { what, hint }));
        }
        reader.u32("the header")?;
        let scene = reader.scene()?;
        match reader.rest.len() {
            0 => scene.checked(),
            left => {
                let problem = Problem::Contradiction(format!("{left} bytes follow the end of the scene"));
                Err(Fault::new("", Place::Byte(reader.at() as u64), problem))
            }
        }
    }

    fn checked(self) -> Result<Self, Fault> {
        for (i, image) in self.images.iter().enumerate() {
            self.check_image(image)
                .map_err(|problem| Fault::new("", Place::File, problem).in_record(|| format!("image {i}")))?;
        }
        let views = self.vertices.iter().enumerate().flat_map(|(i, v)| v.views.iter().map(move |view| (i, view.image)));
        match views.into_iter().find(|&(_, image)| image as usize >= self.images.len()) {
            Some((i, image)) => {
                Err(Fault::new("", Place::File, absent("image", image)).in_record(|| format!("vertex {i}")))
            }
            None => Ok(self),
        }
    }

    fn check_image(&self, image: &Image) -> Result<(), Problem> {
        let platform = self.platforms.get(image.platform as usize).ok_or_else(|| absent("platform", image.platform))?;
        if image.camera as usize >= platform.cameras.len() {
            return Err(absent("camera", image.camera));
        }
        if image.pose != NO_POSE && image.pose as usize >= platform.poses.len() {
            return Err(absent("pose", image.pose));
        }
        match image.view_scores.iter().find(|s| s.index as usize >= self.images.len()) {
            Some(score) => Err(absent("image", score.index)),
            None => Ok(()),
        }
    }

    /// The cameras and images alone.
    pub fn without_points(self) -> Self {
        let Self { version, platforms, images, transform, region, .. } = self;
        Self { version, platforms, images, transform, region, ..Self::default() }
    }

    /// The bytes of the file, in the form of `version`.
    pub fn write(&self) -> Vec<u8> {
        let mut w = Writer { bytes: b"MVSI".to_vec(), version: self.version };
        w.u32(self.version);
        w.u32(0);
        w.list(&self.platforms, Writer::platform);
        w.list(&self.images, Writer::image);
        w.list(&self.vertices, |w, v| {
            w.f32s(&v.x);
            w.list(&v.views, Writer::vertex_view);
        });
        w.list(&self.normals, |w, n| w.f32s(n));
        w.list(&self.colours, |w, c| w.bytes.extend_from_slice(c));
        w.list(&self.lines, |w, line| {
            line.ends.iter().for_each(|end| w.f32s(end));
            w.list(&line.views, Writer::vertex_view);
        });
        w.list(&self.line_normals, |w, n| w.f32s(n));
        w.list(&self.line_colours, |w, c| w.bytes.extend_from_slice(c));
        if self.version > 1 {
            w.f64s(&self.transform);
        }
        if self.version > 5 {
            w.f64s(&self.region);
        }
        w.bytes
    }
}

/// Bytes that don't begin as an interface file does.
fn foreign(bytes: &[u8]) -> Problem {
    let start = String::from_utf8_lossy(&bytes[..bytes.len().min(4)]);
    Problem::Unsupported {
        what: format!("not a scene of OpenMVS in its interface form: it begins with {start:?}, not with \"MVSI\""),
        hint: "Import the model into OpenMVS again; its own archives (--archive-type 1 and 2) cannot be read.",
    }
}

fn absent(what: &'static str, index: u32) -> Problem {
    Problem::Absent { what, id: index.into() }
}

struct Reader<'a> {
    all: usize,
    rest: &'a [u8],
    version: u32,
}

impl<'a> Reader<'a> {
    fn at(&self) -> usize {
        self.all - self.rest.len()
    }

    fn take<T>(&mut self, what: &'static str, parser: impl Fn(&'a [u8]) -> IResult<&'a [u8], T>) -> Result<T, Fault> {
        let (rest, value) = parser(self.rest).map_err(|_| self.fault(Problem::Truncated(what)))?;
        self.rest = rest;
        Ok(value)
    }

    fn u32(&mut self, what: &'static str) -> Result<u32, Fault> {
        self.take(what, le_u32)
    }

    fn f64s<const N: usize>(&mut self, what: &'static str) -> Result<[f64; N], Fault> {
        self.take(what, array(le_f64))
    }

    fn text(&mut self, what: &'static str) -> Result<Vec<u8>, Fault> {
        self.take(what, |bytes| {
            let (rest, length) = le_u64(bytes)?;
            take(length)(rest).map(|(rest, text): (_, &[u8])| (rest, text.to_vec()))
        })
    }

    /// A counted list. `least` is the size of the smallest element: a count beyond the end of the file allocates nothing.
    fn list<T>(
        &mut self,
        what: &'static str,
        least: usize,
        mut element: impl FnMut(&mut Self) -> Result<T, Fault>,
    ) -> Result<Vec<T>, Fault> {
        let count = self.take(what, le_u64)?;
        let room = self.rest.len() / least;
        match usize::try_from(count).ok().filter(|&n| n <= room) {
            Some(n) => (0..n).map(|_| element(self)).collect(),
            None => Err(self.fault(Problem::Count { what, count, room: room as u64 })),
        }
    }

    fn fault(&self, problem: Problem) -> Fault {
        Fault::new("", Place::Byte(self.at() as u64), problem)
    }

    fn scene(&mut self) -> Result<Mvs, Fault> {
        let mut scene = Mvs { version: self.version, ..Mvs::default() };
        scene.platforms = self.list("platforms", 24, Self::platform)?;
        scene.images = self.list("images", 20, Self::image)?;
        (0..).zip(&mut scene.images).filter(|(_, image)| image.id == NO_ID).for_each(|(i, image)| image.id = i);
        scene.vertices = self
            .list("vertices", 20, |r| Ok(Vertex { x: r.take("a vertex", array(le_f32))?, views: r.vertex_views()? }))?;
        scene.normals = self.list("normals", 12, |r| r.take("a normal", array(le_f32)))?;
        scene.colours = self.list("colours", 3, |r| r.take("a colour", array(le_u8)))?;
        scene.lines = self.list("lines", 32, |r| {
            let ends = [r.take("a line", array(le_f32))?, r.take("a line", array(le_f32))?];
            Ok(Line { ends, views: r.vertex_views()? })
        })?;
        scene.line_normals = self.list("normals of lines", 12, |r| r.take("a normal", array(le_f32)))?;
        scene.line_colours = self.list("colours of lines", 3, |r| r.take("a colour", array(le_u8)))?;
        if self.version > 1 {
            scene.transform = self.f64s("the transform")?;
        }
        if self.version > 5 {
            scene.region = self.f64s("the region of interest")?;
        }
        Ok(scene)
    }

    fn platform(&mut self) -> Result<Platform, Fault> {
        Ok(Platform {
            name: self.text("a platform's name")?,
            cameras: self.list("cameras", 176, Self::camera)?,
            poses: self.list("poses", 96, |r| Ok(Pose { r: r.f64s("a pose")?, c: r.f64s("a pose")? }))?,
        })
    }

    fn camera(&mut self) -> Result<Camera, Fault> {
        Ok(Camera {
            name: self.text("a camera's name")?,
            band: if self.version > 3 { self.text("a camera's band")? } else { Vec::new() },
            width: self.u32("a camera's width")?,
            height: self.u32("a camera's height")?,
            k: self.f64s("K")?,
            r: self.f64s("a camera's rotation")?,
            c: self.f64s("a camera's centre")?,
        })
    }

    fn image(&mut self) -> Result<Image, Fault> {
        let mut image = Image {
            name: self.text("an image's name")?,
            mask: if self.version > 4 { self.text("a mask's name")? } else { Vec::new() },
            platform: self.u32("an image")?,
            camera: self.u32("an image")?,
            pose: self.u32("an image")?,
            id: if self.version > 2 { self.u32("an image's ID")? } else { NO_ID },
            depths: [0.0; 3],
            view_scores: Vec::new(),
        };
        if self.version > 6 {
            image.depths = self.take("an image's depths", array(le_f32))?;
            image.view_scores = self.list("view scores", 24, Self::view_score)?;
        }
        Ok(image)
    }

    fn view_score(&mut self) -> Result<ViewScore, Fault> {
        let (index, points) = (self.u32("a view score")?, self.u32("a view score")?);
        let [scale, angle, area, score] = self.take("a view score", array(le_f32))?;
        Ok(ViewScore { index, points, scale, angle, area, score })
    }

    fn vertex_views(&mut self) -> Result<Vec<VertexView>, Fault> {
        self.list("views of a vertex", 8, |r| {
            Ok(VertexView { image: r.u32("a view of a vertex")?, confidence: r.take("a view of a vertex", le_f32)? })
        })
    }
}

/// N values of one kind.
fn array<'a, T: Copy + Default, const N: usize>(
    one: impl Fn(&'a [u8]) -> IResult<&'a [u8], T>,
) -> impl Fn(&'a [u8]) -> IResult<&'a [u8], [T; N]> {
    move |bytes| {
        let mut values = [T::default(); N];
        let (rest, ()) = fill(&one, &mut values).parse(bytes)?;
        Ok((rest, values))
    }
}

struct Writer {
    bytes: Vec<u8>,
    version: u32,
}

impl Writer {
    fn u32(&mut self, value: u32) {
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    fn f32s(&mut self, values: &[f32]) {
        values.iter().for_each(|v| self.bytes.extend_from_slice(&v.to_le_bytes()));
    }

    fn f64s(&mut self, values: &[f64]) {
        values.iter().for_each(|v| self.bytes.extend_from_slice(&v.to_le_bytes()));
    }

    fn text(&mut self, text: &[u8]) {
        self.bytes.extend_from_slice(&(text.len() as u64).to_le_bytes());
        self.bytes.extend_from_slice(text);
    }

    fn list<T>(&mut self, list: &[T], element: impl Fn(&mut Self, &T)) {
        self.bytes.extend_from_slice(&(list.len() as u64).to_le_bytes());
        list.iter().for_each(|e| element(self, e));
    }

    fn platform(&mut self, platform: &Platform) {
        self.text(&platform.name);
        self.list(&platform.cameras, Self::camera);
        self.list(&platform.poses, |w, pose| {
            w.f64s(&pose.r);
            w.f64s(&pose.c);
        });
    }

    fn camera(&mut self, camera: &Camera) {
        self.text(&camera.name);
        if self.version > 3 {
            self.text(&camera.band);
        }
        self.u32(camera.width);
        self.u32(camera.height);
        self.f64s(&camera.k);
        self.f64s(&camera.r);
        self.f64s(&camera.c);
    }

    fn image(&mut self, image: &Image) {
        self.text(&image.name);
        if self.version > 4 {
            self.text(&image.mask);
        }
        self.u32(image.platform);
        self.u32(image.camera);
        self.u32(image.pose);
        if self.version > 2 {
            self.u32(image.id);
        }
        if self.version > 6 {
            self.f32s(&image.depths);
            self.list(&image.view_scores, |w, s| {
                w.u32(s.index);
                w.u32(s.points);
                w.f32s(&[s.scale, s.angle, s.area, s.score]);
            });
        }
    }

    fn vertex_view(&mut self, view: &VertexView) {
        self.u32(view.image);
        self.f32s(&[view.confidence]);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A camera, three images and four points that all see.
    fn small(version: u32) -> Mvs {
        let camera = Camera { name: b"c".into(), width: 4, height: 3, k: [1.0; 9], ..Camera::default() };
        let poses = (0..3).map(|i| Pose { r: [f64::from(i); 9], c: [0.5; 3] }).collect();
        let score = |index| ViewScore { index, points: 9, scale: 1.0, angle: 0.2, area: 0.5, score: 3.0 };
        let image = |i: u32| Image {
            name: format!("images/{i}.jpg").into_bytes(),
            mask: Vec::new(),
            platform: 0,
            camera: 0,
            pose: i,
            id: if version > 2 { 40 + i } else { i },
            depths: if version > 6 { [1.0, 2.0, 3.0] } else { [0.0; 3] },
            view_scores: if version > 6 { vec![score((i + 1) % 3), score((i + 2) % 3)] } else { Vec::new() },
        };
        let views = (0..3).map(|image| VertexView { image, confidence: 1.0 }).collect::<Vec<_>>();
        Mvs {
            version,
            platforms: vec![Platform { name: Vec::new(), cameras: vec![camera], poses }],
            images: (0..3).map(image).collect(),
            vertices: (0..4).map(|i| Vertex { x: [i as f32; 3], views: views.clone() }).collect(),
            colours: vec![[1, 2, 3]; 4],
            ..Mvs::default()
        }
    }

    #[test]
    fn every_version_is_read_back() {
        for version in 1..=NEWEST {
            let bytes = small(version).write();
            let read = Mvs::read(&bytes).unwrap();
            assert_eq!(read, small(version), "version {version}");
            assert_eq!(read.write(), bytes);
        }
    }

    /// As OpenMVS does when it loads a scene.
    #[test]
    fn an_image_without_id_has_its_index() {
        for version in 1..=NEWEST {
            let mut scene = small(version);
            (scene.images[0].id, scene.images[2].id) = (NO_ID, NO_ID);
            let ids: Vec<u32> = Mvs::read(&scene.write()).unwrap().images.iter().map(|image| image.id).collect();
            assert_eq!(ids, [0, if version > 2 { 41 } else { 1 }, 2], "version {version}");
        }
    }

    /// Measured with OpenMVS's own header, one version compiled after the other.
    #[test]
    fn versions_grow_as_in_openmvs() {
        let sizes: Vec<usize> = (1..=NEWEST).map(|v| small(v).write().len()).collect();
        let grown: Vec<usize> = sizes.windows(2).map(|w| w[1] - w[0]).collect();
        assert_eq!(grown, [128, 12, 8, 24, 120, 204]);
    }

    #[test]
    fn every_cut_is_an_error() {
        let bytes = small(7).write();
        for length in 0..bytes.len() {
            assert!(Mvs::read(&bytes[..length]).is_err(), "{length} bytes");
        }
        assert!(Mvs::read(&[&bytes[..], &[0]].concat()).is_err_and(|e| e.to_string().contains("1 bytes follow")));
    }

    #[test]
    fn openmvs_version_too_new() {
        let mut bytes = small(7).write();
        bytes[4] = 8;
        assert!(Mvs::read(&bytes).is_err_and(|e| e.to_string().contains("version 8")));
    }

    #[test]
    fn a_huge_count_allocates_nothing() {
        let mut bytes = b"MVSI\x07\0\0\0\0\0\0\0".to_vec();
        bytes.extend_from_slice(&(1u64 << 60).to_le_bytes());
        let problem = Problem::Count { what: "platforms", count: 1 << 60, room: 0 };
        assert_eq!(Mvs::read(&bytes), Err(Fault::new("", Place::Byte(20), problem)));
    }

    #[test]
    fn an_index_out_of_range_is_named() {
        let mut scene = small(7);
        scene.images[1].pose = 3;
        assert_eq!(
            Mvs::read(&scene.write()).unwrap_err().to_string(),
            "whole file (image 1): it refers to pose 3, which is not in the model"
        );
        let mut scene = small(7);
        scene.vertices[2].views[0].image = 3;
        assert_eq!(
            Mvs::read(&scene.write()).unwrap_err().to_string(),
            "whole file (vertex 2): it refers to image 3, which is not in the model"
        );
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..400), version in 0u8..9) {
            let _ = Mvs::read(&bytes);
            bytes.splice(0..0, [b'M', b'V', b'S', b'I', version, 0, 0, 0, 0, 0, 0, 0]);
            let _ = Mvs::read(&bytes);
        }

        #[test]
        fn no_changed_byte_makes_it_panic(at in 12usize..1300, value in any::<u8>()) {
            let mut bytes = small(7).write();
            if let Some(byte) = bytes.get_mut(at) {
                *byte = value;
            }
            let _ = Mvs::read(&bytes);
        }
    }
}
