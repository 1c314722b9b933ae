//! `flotilla rollout`: plays teams of policies from a file, and scores every leader.

use std::cell::RefCell;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use super::{ConfigArgs, Error, RunOptions, backend, output, print, say};
use crate::backend::{Backend, Group};
use crate::credit::Credit;
use crate::record::policies;
use crate::world::World;

/// Most bytes of a trace in memory at once.
const TRACE_BYTES: usize = 1 << 26;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    #[command(flatten)]
    run: RunOptions,
    /// Safetensors file with a tensor `weights` or `weights.N`, f32 [leaders, policies, parameters]
    #[arg(long, value_name = "FILE")]
    policies: PathBuf,
    /// Take the tensor `weights.N` [default: `weights`, or else `weights.0`]
    #[arg(long, value_name = "N")]
    trial: Option<usize>,
    /// Write every agent's state after every step: team,step,agent,role,x,y,heading_x,heading_y,speed
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// Write every leader's scores: team,leader,g,d,df,dpp
    #[arg(long, value_name = "FILE")]
    scores: Option<PathBuf>,
}

/// Team j is made of the policies with index j of every leader, and starts where the config says.
pub fn run(args: Args) -> Result<(), Error> {
    let outputs = [("--scores", args.scores.as_deref()), ("--trace", args.trace.as_deref())];
    output::check(&outputs, &[&args.config.config, &args.policies])?;
    let config = args.config.load()?;
    let policies = policies::read(&args.policies, &config, args.trial)?;
    let world = World::new(&config);
    let (mut backend, _) = backend::open(&args.run)?;
    say(format_args!("playing on {}", backend.describe()));
    let teams: Vec<u32> =
        (0..policies.policies as u32).flat_map(|policy| std::iter::repeat_n(policy, world.leaders())).collect();
    let group = Group {
        world: &world,
        starts: &world.starts,
        weights: policies.weights[..].into(),
        policies: policies.policies,
        teams: &teams,
    };

    let scores = score(&mut *backend, &group)?;
    if let Some(path) = &args.scores {
        output::write(path, |file| write_scores(file, &scores, world.leaders()))?;
    }
    if let Some(path) = &args.trace {
        write_trace(path, &mut *backend, &group)?;
    }
    let g = |team: &[[f32; 4]]| f64::from(team[0][0]);
    let pois = world.pois.len();
    let all: Vec<f64> = scores.chunks_exact(world.leaders()).map(|team| g(team) * pois as f64).collect();
    let best = (0..all.len()).fold(0, |best, team| if all[team] > all[best] { team } else { best });
    let mean = all.iter().sum::<f64>() / all.len() as f64;
    print(&format!(
        "{} teams, POIs observed of {pois}: team 0 {:.2}, best {:.2} (team {best}), mean {mean:.2}\n",
        all.len(),
        all[0],
        all[best]
    ))
}

/// G, D, Df and D++ of every leader of every team, `[teams][leaders]`.
fn score(backend: &mut dyn Backend, group: &Group<'_>) -> Result<Vec<[f32; 4]>, Error> {
    thread_local! { static CREDIT: RefCell<Credit> = RefCell::default(); }
    let leaders = group.world.leaders();
    let all = Mutex::new(vec![[0.0; 4]; group.teams.len()]);
    backend.rollout(std::slice::from_ref(group), &|episode| {
        let scores = CREDIT.with_borrow_mut(|credit| credit.all(&episode, group.world));
        let mut all = all.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        for (leader, to) in all[episode.team * leaders..][..leaders].iter_mut().enumerate() {
            *to = [scores.g, scores.d[leader], scores.df[leader], scores.dpp[leader]];
        }
    })?;
    Ok(all.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner()))
}

/// Floats are printed in the fewest digits that read back to the same bits.
fn write_scores(file: &mut dyn Write, scores: &[[f32; 4]], leaders: usize) -> io::Result<()> {
    writeln!(file, "team,leader,g,d,df,dpp")?;
    for (index, [g, d, df, dpp]) in scores.iter().enumerate() {
        writeln!(file, "{},{},{g},{d},{df},{dpp}", index / leaders, index % leaders)?;
    }
    Ok(())
}

fn write_trace(path: &Path, backend: &mut dyn Backend, group: &Group<'_>) -> Result<(), Error> {
    let (leaders, agents, steps) = (group.world.leaders(), group.world.agents(), group.world.steps());
    let team_bytes = (steps + 1) * agents * size_of::<crate::backend::Moment>() + group.world.set_words() * 4;
    let teams = (TRACE_BYTES / team_bytes).max(1);
    let mut failed = None;
    let written = output::write(path, |file| {
        writeln!(file, "team,step,agent,role,x,y,heading_x,heading_y,speed")?;
        for (part, chosen) in group.teams.chunks(teams * leaders).enumerate() {
            let trace = match backend.trace(&Group { teams: chosen, ..*group }) {
                Ok(trace) => trace,
                Err(error) => {
                    failed = Some(error);
                    return Err(io::ErrorKind::Other.into());
                }
            };
            for team in 0..trace.teams {
                for step in 0..=steps {
                    for agent in 0..agents {
                        let moment = trace.moment(step, team, agent);
                        let role = if agent < leaders { "leader" } else { "follower" };
                        let ([x, y], [hx, hy], speed) = (moment.position, moment.heading, moment.speed);
                        writeln!(file, "{},{step},{agent},{role},{x},{y},{hx},{hy},{speed}", part * teams + team)?;
                    }
                }
            }
        }
        Ok(())
    });
    failed.map_or(written, |error| Err(error.into()))
}
