//! The model of a chunk.

use std::collections::{HashMap, HashSet};

use viewrank_core::model::scene::{ModelWarning, WarningKind};

use super::{
    Chunk, ChunkCamera, Frame, Sensor,
    lens::Lens,
    placement::{Placement, Similarity},
};
use crate::formats::{
    Fault, Problem,
    foreign::{ForeignModel, largest_component},
};

/// Longest name of a folder, bytes: that of a group or a sensor may be part of many names.
const LONGEST_FOLDER: usize = 255;

impl Chunk {
    /// Makes the model of the component with most images.
    pub fn model(&self, frame: Frame, names: &[String]) -> Result<ForeignModel, Fault> {
        let mut model = ChunkModel::new(self, frame);
        let mut disabled = Vec::new();
        for ((n, camera), name) in (1..).zip(&self.cameras).zip(names) {
            if !camera.is_enabled {
                disabled.push(name.clone());
                continue;
            }
            model
                .add(n, camera, name.clone())
                .map_err(|fault| fault.in_record(|| format!("camera {n}, {:?}", camera.label)))?;
        }
        let mut foreign = model.into_largest_component();
        if let Some(first) = disabled.first() {
            let text = match disabled.len() {
                1 => format!("the disabled camera {first} is left out"),
                n => format!("{n} disabled cameras are left out, e.g. {first}"),
            };
            let warning = ModelWarning::new(WarningKind::Format, text);
            let warning = if foreign.model.images.is_empty() {
                warning.with_cure("enable the cameras in Metashape, and export them again")
            } else {
                warning
            };
            foreign.model.warnings.push(warning);
        }
        foreign.left_out = disabled;
        Ok(foreign)
    }

    /// Names of the images of all cameras: their labels. Of several cameras of a label, each has
    /// its group, or its sensor, for a folder, and its id where that does not tell them apart.
    pub fn names(&self, spelled: &dyn Fn(&str) -> String) -> Vec<String> {
        let mut same_label: HashMap<&str, usize> = HashMap::new();
        let mut same_path: HashMap<(&str, Option<&str>), usize> = HashMap::new();
        for camera in &self.cameras {
            *same_label.entry(&camera.label).or_default() += 1;
            let path = (&*camera.label, self.folder(camera));
            *same_path.entry(path).or_default() += 1;
        }
        let name = |camera: &ChunkCamera| {
            let label = &*camera.label;
            let folder = self.folder(camera);
            spelled(&if same_label[label] == 1 {
                label.replace('\\', "/")
            } else {
                camera.path_in(folder, same_path[&(label, folder)] == 1)
            })
        };
        self.cameras.iter().map(name).collect()
    }

    /// The folder of a camera among several of its label.
    fn folder<'a>(&'a self, camera: &'a ChunkCamera) -> Option<&'a str> {
        let of_sensor = || self.sensor(camera).ok()?.label.as_deref();
        let folder = camera.group.as_deref().or_else(of_sensor);
        folder.filter(|folder| folder.len() <= LONGEST_FOLDER)
    }

    /// The transform from the chunk that applies to a component's cameras.
    fn to_world(&self, component: &str) -> Option<&Similarity> {
        let of_component = self.components.get(component);
        of_component.or(self.transform.as_ref())
    }

    fn sensor(&self, camera: &ChunkCamera) -> Result<&Sensor, Fault> {
        let id = &camera.sensor_id;
        self.sensors.get(id).ok_or_else(|| {
            let problem = Problem::Syntax {
                expected: "the id of a sensor",
                found: format!("sensor_id {id:?}"),
            };
            problem.at(camera.at)
        })
    }

    /// The placement of a camera in the chunk, its own or by that of its master in a rig, and the
    /// id of its component; `None` if it is not aligned.
    fn placement<'a>(
        &self,
        camera: &'a ChunkCamera,
        by_id: &HashMap<&str, &'a ChunkCamera>,
    ) -> Result<Option<(Placement, &'a str)>, Fault> {
        if let Some(own) = camera.placement.clone()? {
            return Ok(Some((own, &camera.component_id)));
        }
        let master = camera.master_id.as_deref().and_then(|id| by_id.get(id));
        let Some(master) = master else {
            return Ok(None);
        };
        let Some(of_master) = master.placement.clone()? else {
            return Ok(None);
        };
        let (rotation, location) = self.sensor(camera)?.mounting.clone()?;
        let placement = of_master.followed_by(rotation, location);
        Ok(Some((placement, &master.component_id)))
    }
}

impl ChunkCamera {
    /// The path of the image if others have its label; `is_apart`: none of these has its folder.
    fn path_in(&self, folder: Option<&str>, is_apart: bool) -> String {
        let label = &self.label;
        let id = self.id.as_deref().unwrap_or_default();
        match folder {
            Some(folder) if is_apart => format!("{folder}/{label}"),
            Some(folder) => format!("{folder}_{id}/{label}"),
            None => format!("camera_{id}/{label}"),
        }
    }
}

/// The model of a chunk, to which cameras are added.
struct ChunkModel<'a> {
    chunk: &'a Chunk,
    frame: Frame,
    cameras_by_id: HashMap<&'a str, &'a ChunkCamera>,
    foreign: ForeignModel,
    /// Numbers of the sensors whose lenses are added.
    sensors: HashSet<u32>,
    lenses: Vec<Lens>,
    /// Component of each image.
    components: Vec<&'a str>,
}

impl<'a> ChunkModel<'a> {
    fn new(chunk: &'a Chunk, frame: Frame) -> Self {
        let cameras = chunk.cameras.iter();
        // Collected before any is added: a slave may come before its master.
        let with_id = cameras.filter_map(|camera| Some((camera.id.as_deref()?, camera)));
        Self {
            chunk,
            frame,
            cameras_by_id: with_id.collect(),
            foreign: ForeignModel::default(),
            sensors: HashSet::new(),
            lenses: Vec::new(),
            components: Vec::new(),
        }
    }

    /// Adds the n-th camera of the chunk.
    fn add(&mut self, n: u32, camera: &'a ChunkCamera, name: String) -> Result<(), Fault> {
        let placement = self.chunk.placement(camera, &self.cameras_by_id)?;
        let Some((placement, component)) = placement else {
            self.foreign.unregistered.push(name);
            return Ok(());
        };
        let sensor = self.chunk.sensor(camera)?;
        self.add_lens(sensor)?;
        let pose = placement
            .pose(self.to_world(component))
            .map_err(|problem| problem.at(camera.at))?;
        self.foreign
            .add_image(n, name, sensor.number, pose, camera.at);
        self.components.push(component);
        Ok(())
    }

    /// Adds the lens of a sensor, unless it is there.
    fn add_lens(&mut self, sensor: &Sensor) -> Result<(), Fault> {
        let id = sensor.number;
        if self.sensors.insert(id) {
            let lens = sensor.lens.clone();
            let lens = lens.map_err(|fault| fault.in_record(|| format!("sensor {id}")))?;
            self.foreign.model.cameras.push(lens.camera.clone());
            self.lenses.push(lens);
        }
        Ok(())
    }

    /// The transform that a component's cameras are given.
    fn to_world(&self, component: &str) -> Option<&'a Similarity> {
        let to_world = self.chunk.to_world(component);
        to_world.filter(|_| self.frame == Frame::World)
    }

    fn into_largest_component(self) -> ForeignModel {
        let (mut foreign, components) = (self.foreign, self.components);
        Lens::warn(&self.lenses, &mut foreign);
        let (largest, others) = largest_component(components.iter().copied());
        // World coordinates that are earth-centred are recognised by themselves.
        if self.frame == Frame::Chunk {
            let to_world = self.chunk.to_world(&largest);
            foreign.georeference = to_world.and_then(Similarity::place);
        }
        foreign.keep_images(|image| components[image] == largest);
        foreign.warn_of_others("components", &others);
        foreign
    }
}
