//! Populations can be held in a third place, here a file, without any change of the library: a backend and its population are enough.

use std::any::Any;
use std::fs;
use std::path::{Path, PathBuf};

use flotilla::backend::cpu::Cpu;
use flotilla::backend::{Backend, BackendError, DevicePopulation, Group, GroupScores, Trace, Weights};
use flotilla::config::{Config, ValidConfig};
use flotilla::evolve::Breeding;
use flotilla::trainer::{Row, Trainer};

/// The populations of one trial in a file.
#[derive(Debug)]
struct InFile {
    path: PathBuf,
    sizes: [usize; 3],
}

impl InFile {
    fn read(&self) -> Vec<f32> {
        bytemuck::pod_collect_to_vec(&fs::read(&self.path).unwrap())
    }

    fn write(&self, weights: &[f32]) {
        fs::write(&self.path, bytemuck::cast_slice(weights)).unwrap();
    }
}

impl DevicePopulation for InFile {
    fn breed(&mut self, breeding: &Breeding<'_>) -> Result<(), BackendError> {
        self.write(&breeding.on_host(self.sizes, &self.read())?);
        Ok(())
    }

    fn fetch(&self, weights: &mut [f32]) -> Result<(), BackendError> {
        weights.copy_from_slice(&self.read());
        Ok(())
    }
}

/// Plays on the CPU, but keeps populations in files between generations.
struct Files<'a> {
    cpu: Cpu,
    folder: &'a Path,
    held: usize,
}

impl Backend for Files<'_> {
    fn play(&mut self, groups: &[Group<'_>]) -> Result<Vec<GroupScores>, BackendError> {
        let weights = |group: &Group<'_>| match group.weights {
            Weights::OnHost(weights) => weights.to_vec(),
            Weights::OnDevice(held) => (held as &dyn Any).downcast_ref::<InFile>().expect("held here").read(),
        };
        let weights: Vec<Vec<f32>> = groups.iter().map(weights).collect();
        let groups = groups.iter().zip(&weights);
        let groups: Vec<Group<'_>> =
            groups.map(|(group, weights)| Group { weights: weights[..].into(), ..*group }).collect();
        self.cpu.play(&groups)
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        self.cpu.trace(group)
    }

    fn hold(&mut self, weights: &[f32], sizes: [usize; 3]) -> Result<Option<Box<dyn DevicePopulation>>, BackendError> {
        let population = InFile { path: self.folder.join(self.held.to_string()), sizes };
        self.held += 1;
        population.write(weights);
        Ok(Some(Box::new(population)))
    }

    fn describe(&self) -> String {
        "cpu, populations in files".into()
    }
}

#[test]
fn populations_in_files_evolve_as_those_in_memory_do() {
    let text = fs::read_to_string("configs/chaotic.toml").unwrap();
    let mut config = Config::parse(&text, "chaotic.toml").unwrap();
    (config.learning.generations, config.learning.trials) = (4, 2);
    let trained = |backend: &mut dyn Backend| -> (Vec<Row>, Vec<Vec<f32>>) {
        let mut trainer = Trainer::new(ValidConfig::all(&[config.clone()]).unwrap());
        let rows = trainer.finish(backend).unwrap();
        (rows, trainer.policies(0))
    };
    let folder = tempfile::tempdir().unwrap();
    let mut files = Files { cpu: Cpu::default(), folder: folder.path(), held: 0 };
    assert_eq!(trained(&mut files), trained(&mut Cpu::default()));
    assert_eq!((files.held, fs::read_dir(folder.path()).unwrap().count()), (2, 2));
}
