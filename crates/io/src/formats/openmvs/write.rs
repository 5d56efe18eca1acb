//! Writes the interface form.

use super::{Camera, Image, Line, Mvs, Platform, Vertex, VertexView};

impl Mvs {
    /// Serialises the scene in the form of `version`.
    pub fn write(&self) -> Vec<u8> {
        let mut w = Writer {
            bytes: b"MVSI".to_vec(),
            version: self.version,
        };
        w.u32(self.version);
        w.u32(0);
        w.list(&self.platforms, Writer::platform);
        w.list(&self.images, Writer::image);
        w.list(&self.vertices, Writer::vertex);
        w.list(&self.normals, |w, n| w.f32s(n));
        w.list(&self.colours, |w, c| w.bytes.extend_from_slice(c));
        w.list(&self.lines, Writer::line);
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

struct Writer {
    bytes: Vec<u8>,
    version: u32,
}

impl Writer {
    fn u32(&mut self, value: u32) {
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    fn f32s(&mut self, values: &[f32]) {
        values
            .iter()
            .for_each(|v| self.bytes.extend_from_slice(&v.to_le_bytes()));
    }

    fn f64s(&mut self, values: &[f64]) {
        values
            .iter()
            .for_each(|v| self.bytes.extend_from_slice(&v.to_le_bytes()));
    }

    fn text(&mut self, text: &[u8]) {
        self.bytes
            .extend_from_slice(&(text.len() as u64).to_le_bytes());
        self.bytes.extend_from_slice(text);
    }

    fn list<T>(&mut self, list: &[T], element: impl Fn(&mut Self, &T)) {
        self.bytes
            .extend_from_slice(&(list.len() as u64).to_le_bytes());
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

    fn vertex(&mut self, vertex: &Vertex) {
        self.f32s(&vertex.x);
        self.list(&vertex.views, Self::vertex_view);
    }

    fn line(&mut self, line: &Line) {
        line.ends.iter().for_each(|end| self.f32s(end));
        self.list(&line.views, Self::vertex_view);
    }

    fn vertex_view(&mut self, view: &VertexView) {
        self.u32(view.image);
        self.f32s(&[view.confidence]);
    }
}
