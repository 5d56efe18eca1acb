//! Reads the interface form. Checks all counts and indices, so users of [`Mvs`] need not.

use nom::{
    IResult, Parser,
    bytes::complete::take,
    multi::fill,
    number::complete::{le_f32, le_f64, le_u8, le_u32, le_u64},
};

use super::{
    Camera, Image, Line, Mvs, NEWEST, NO_ID, NO_POSE, Platform, PlatformPose, Vertex, VertexView,
    ViewScore,
};
use crate::formats::{Fault, Place, Problem, check_images};

impl Mvs {
    /// Reads a scene and checks that all its indices are valid.
    ///
    /// # Errors
    /// If the bytes are truncated or inconsistent, or have an unsupported version.
    pub fn read(bytes: &[u8]) -> Result<Self, Fault> {
        let mut reader = Reader {
            all: bytes.len(),
            rest: bytes,
            version: 0,
        };
        if bytes.get(..4) != Some(b"MVSI") {
            return Err(foreign(bytes).at(Place::Byte(0)));
        }
        reader.header()?;
        let scene = reader.scene()?;
        match reader.rest.len() {
            0 => scene.checked(),
            left => {
                let problem =
                    Problem::Contradiction(format!("{left} bytes follow the end of the scene"));
                Err(problem.at(Place::Byte(reader.offset() as u64)))
            }
        }
    }

    fn checked(self) -> Result<Self, Fault> {
        for (i, image) in self.images.iter().enumerate() {
            self.check_image(image)
                .map_err(|problem| problem.at(Place::File).in_record(|| format!("image {i}")))?;
        }
        let views = self
            .vertices
            .iter()
            .enumerate()
            .flat_map(|(i, v)| v.views.iter().map(move |view| (i, view.image)));
        match views
            .into_iter()
            .find(|&(_, image)| image as usize >= self.images.len())
        {
            Some((i, image)) => Err(Problem::absent("image", image)
                .at(Place::File)
                .in_record(|| format!("vertex {i}"))),
            None => Ok(self),
        }
    }

    fn check_image(&self, image: &Image) -> Result<(), Problem> {
        let platform = self
            .platforms
            .get(image.platform as usize)
            .ok_or_else(|| Problem::absent("platform", image.platform))?;
        if image.camera as usize >= platform.cameras.len() {
            return Err(Problem::absent("camera", image.camera));
        }
        if image.pose != NO_POSE && image.pose as usize >= platform.poses.len() {
            return Err(Problem::absent("pose", image.pose));
        }
        match image
            .view_scores
            .iter()
            .find(|s| s.index as usize >= self.images.len())
        {
            Some(score) => Err(Problem::absent("image", score.index)),
            None => Ok(()),
        }
    }
}

/// Error for bytes that don't begin with "MVSI".
fn foreign(bytes: &[u8]) -> Problem {
    let start = String::from_utf8_lossy(&bytes[..bytes.len().min(4)]);
    Problem::Unsupported {
        what: format!(
            "not an OpenMVS scene in interface form: it begins with {start:?} instead of \"MVSI\""
        ),
        hint: "import the model into OpenMVS again; its own archives (--archive-type 1 and 2) aren't supported",
    }
}

struct Reader<'a> {
    all: usize,
    rest: &'a [u8],
    version: u32,
}

impl<'a> Reader<'a> {
    fn offset(&self) -> usize {
        self.all - self.rest.len()
    }

    fn take<T>(
        &mut self,
        what: &'static str,
        parser: impl Fn(&'a [u8]) -> IResult<&'a [u8], T>,
    ) -> Result<T, Fault> {
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

    /// Reads a counted list. `least`: bytes of the smallest element, to refuse a count too large
    /// for the file before allocating.
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
            None => Err(self.fault(Problem::Count {
                what,
                count,
                room: room as u64,
            })),
        }
    }

    fn fault(&self, problem: Problem) -> Fault {
        problem.at(Place::Byte(self.offset() as u64))
    }

    /// Reads the signature, the version, which must be known, and a reserved number.
    fn header(&mut self) -> Result<(), Fault> {
        self.u32("the header")?;
        let at = self.offset();
        self.version = self.u32("the header")?;
        if !(1..=NEWEST).contains(&self.version) {
            let what = format!(
                "unsupported interface version {} (supported: 1 to {NEWEST})",
                self.version
            );
            let hint = "write the scene with OpenMVS v1.0 to v2.3";
            return Err(Problem::Unsupported { what, hint }.at(Place::Byte(at as u64)));
        }
        self.u32("the header").map(drop)
    }

    fn scene(&mut self) -> Result<Mvs, Fault> {
        let mut scene = Mvs {
            version: self.version,
            ..Mvs::default()
        };
        scene.platforms = self.list("platforms", 24, Self::platform)?;
        scene.images = self.images()?;
        scene.vertices = self.list("vertices", 20, Self::vertex)?;
        scene.normals = self.list("normals", 12, Self::normal)?;
        scene.colours = self.list("colours", 3, Self::colour)?;
        scene.lines = self.list("lines", 32, Self::line)?;
        scene.line_normals = self.list("normals of lines", 12, Self::normal)?;
        scene.line_colours = self.list("colours of lines", 3, Self::colour)?;
        if self.version > 1 {
            scene.transform = self.f64s("the transform")?;
        }
        if self.version > 5 {
            scene.region = self.f64s("the region of interest")?;
        }
        Ok(scene)
    }

    /// Reads the images; those without an id have their position for it.
    fn images(&mut self) -> Result<Vec<Image>, Fault> {
        let mut read = 0;
        let mut images = self.list("images", 20, |reader| {
            read += 1;
            // One by one: an image of 20 bytes in the file takes far more in memory.
            check_images(read)?;
            reader.image()
        })?;
        for (position, image) in (0..).zip(&mut images) {
            if image.id == NO_ID {
                image.id = position;
            }
        }
        Ok(images)
    }

    fn platform(&mut self) -> Result<Platform, Fault> {
        Ok(Platform {
            name: self.text("a platform's name")?,
            cameras: self.list("cameras", 176, Self::camera)?,
            poses: self.list("poses", 96, |r| {
                Ok(PlatformPose {
                    r: r.f64s("a pose")?,
                    c: r.f64s("a pose")?,
                })
            })?,
        })
    }

    /// A text that files after this version have.
    fn text_after(&mut self, version: u32, what: &'static str) -> Result<Vec<u8>, Fault> {
        if self.version > version {
            self.text(what)
        } else {
            Ok(Vec::new())
        }
    }

    fn camera(&mut self) -> Result<Camera, Fault> {
        Ok(Camera {
            name: self.text("a camera's name")?,
            band: self.text_after(3, "a camera's band")?,
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
            mask: self.text_after(4, "a mask's name")?,
            platform: self.u32("an image")?,
            camera: self.u32("an image")?,
            pose: self.u32("an image")?,
            id: if self.version > 2 {
                self.u32("an image's ID")?
            } else {
                NO_ID
            },
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
        Ok(ViewScore {
            index,
            points,
            scale,
            angle,
            area,
            score,
        })
    }

    fn vertex(&mut self) -> Result<Vertex, Fault> {
        Ok(Vertex {
            x: self.take("a vertex", array(le_f32))?,
            views: self.vertex_views()?,
        })
    }

    fn line(&mut self) -> Result<Line, Fault> {
        let ends = [
            self.take("a line", array(le_f32))?,
            self.take("a line", array(le_f32))?,
        ];
        Ok(Line {
            ends,
            views: self.vertex_views()?,
        })
    }

    fn normal(&mut self) -> Result<[f32; 3], Fault> {
        self.take("a normal", array(le_f32))
    }

    fn colour(&mut self) -> Result<[u8; 3], Fault> {
        self.take("a colour", array(le_u8))
    }

    fn vertex_views(&mut self) -> Result<Vec<VertexView>, Fault> {
        self.list("views of a vertex", 8, |r| {
            Ok(VertexView {
                image: r.u32("a view of a vertex")?,
                confidence: r.take("a view of a vertex", le_f32)?,
            })
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
