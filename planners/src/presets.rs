//! Named settings: the paper's, and some that suit a CPU.

use crate::config::{
    ConfidenceConfig, ConfidenceRule, Config, CuriosityConfig, DataConfig, DiffusionConfig, Mode,
    NetworkConfig, PlanningConfig, RewardConfig, RewardRule, Solver,
};
use crate::data::Subset;
use crate::family::Preset;

/// The presets of every diffusion planner.
pub(crate) const PRESETS: &[Preset] = &[
    preset("cpu", "running robots, trained in half an hour on one core"),
    preset(
        "cpu-antmaze",
        "AntMaze, trained in a few hours on two cores",
    ),
    preset(
        "smoke",
        "some dozen updates of tiny networks: shows that everything works, plans nothing of use",
    ),
    preset("smoke-antmaze", "the same on datasets with goals"),
    preset("paper-hopper-medium-expert", "the paper's, 10^6 updates"),
    preset("paper-hopper-medium-replay", "the paper's, 10^6 updates"),
    preset("paper-hopper-medium", "the paper's, 10^6 updates"),
    preset("paper-walker2d-medium-expert", "the paper's, 10^6 updates"),
    preset("paper-walker2d-medium-replay", "the paper's, 10^6 updates"),
    preset("paper-walker2d-medium", "the paper's, 10^6 updates"),
    preset(
        "paper-halfcheetah-medium-expert",
        "the paper's, 10^6 updates",
    ),
    preset(
        "paper-halfcheetah-medium-replay",
        "the paper's, 10^6 updates",
    ),
    preset("paper-halfcheetah-medium", "the paper's, 10^6 updates"),
    preset("paper-antmaze", "the paper's, 10^6 updates"),
];

/// The CPU preset for a dataset whose observations contain a goal, and for others.
pub(crate) fn default_preset(has_goal: bool) -> &'static str {
    if has_goal { "cpu-antmaze" } else { "cpu" }
}

const fn preset(name: &'static str, summary: &'static str) -> Preset {
    Preset { name, summary }
}

/// Settings of a preset that all diffusion planners share.
pub(crate) fn base(name: &str) -> Option<Config> {
    let config = match name {
        "cpu" => cpu(),
        "cpu-antmaze" => cpu_antmaze(),
        "smoke" => smoke(),
        "smoke-antmaze" => smoke_antmaze(),
        "paper-antmaze" => antmaze(),
        _ => mujoco(name.strip_prefix("paper-")?)?,
    };
    Some(config)
}

/// The paper's settings for D4RL's running robots, with the guidance weights of the released configuration.
fn mujoco(dataset: &str) -> Option<Config> {
    let (dim_mult, horizon, guidance_weight) = match dataset {
        "hopper-medium-expert" => (vec![1, 2, 2, 2], 32, 1e-5),
        "hopper-medium-replay" => (vec![1, 2, 2, 2], 32, 0.2),
        "hopper-medium" => (vec![1, 2, 2, 2], 32, 0.3),
        "walker2d-medium-expert" => (vec![1, 2, 2, 2], 32, 1e-3),
        "walker2d-medium-replay" => (vec![1, 2, 2, 2], 32, 0.01),
        "walker2d-medium" => (vec![1, 2, 2, 2], 32, 0.007),
        "halfcheetah-medium-expert" | "halfcheetah-medium-replay" | "halfcheetah-medium" => {
            (vec![1, 4, 2], 4, 1e-4)
        }
        _ => return None,
    };
    Some(Config {
        mode: Mode::Corrected,
        data: DataConfig {
            horizon,
            max_path_length: 1000,
            discount: 0.997,
            rule: RewardRule::Locomotion,
            terminal_penalty: -100.0,
            goal_bonus: 0.0,
            reward_offset: 0.0,
        },
        networks: NetworkConfig {
            model_dim: 32,
            embedding_dim: 32,
            dim_mult,
            kernel_size: 5,
            classifier_kernel_size: 3,
        },
        diffusion: DiffusionConfig {
            n_timesteps: 20,
            n_updates: 1_000_000,
            batch_size: 64,
            learning_rate: 2e-4,
            weight_decay: 1e-5,
            ema_rate: 0.9999,
            action_loss_weight: 10.0,
        },
        reward: RewardConfig {
            interval: 1,
            learning_rate: 2e-4,
            weight_decay: 1e-4,
            ema_rate: 0.995,
        },
        curiosity: None,
        confidence: None,
        planning: PlanningConfig {
            solver: Solver::Ddpm,
            sampling_steps: 20,
            n_candidates: 64,
            temperature: 0.5,
            guidance_weight,
            curiosity_weight: 1000.0,
        },
        checkpoint_interval: 10_000,
    })
}

/// The paper's settings for AntMaze in Minari.
fn antmaze() -> Config {
    let mujoco = mujoco("hopper-medium-expert");
    let mut config = mujoco.unwrap_or_else(|| unreachable!("a preset of the list"));
    config.data = DataConfig {
        horizon: 64,
        max_path_length: 1000,
        discount: 0.99,
        rule: RewardRule::Goal,
        terminal_penalty: -100.0,
        goal_bonus: 100.0,
        reward_offset: -0.5,
    };
    config.networks.model_dim = 64;
    config.networks.embedding_dim = 64;
    config.planning.guidance_weight = 1e-3;
    config.planning.curiosity_weight = 10.0;
    config
}

/// Short plans by small networks: an update costs about a tenth of the paper's.
fn cpu() -> Config {
    let mujoco = mujoco("hopper-medium-expert");
    let mut config = mujoco.unwrap_or_else(|| unreachable!("a preset of the list"));
    config.data.horizon = 16;
    config.networks.dim_mult = vec![1, 2, 2];
    config.diffusion.n_updates = 50_000;
    config.diffusion.batch_size = 32;
    config.diffusion.learning_rate = 5e-4;
    // The average must forget its start within a training this short.
    config.diffusion.ema_rate = 0.999;
    config.reward.interval = 2;
    config.reward.learning_rate = 5e-4;
    config.planning.sampling_steps = 10;
    config.planning.n_candidates = 8;
    config.planning.guidance_weight = 1e-4;
    config.checkpoint_interval = 1000;
    config
}

/// As `cpu`, with plans long enough to go around a corner.
fn cpu_antmaze() -> Config {
    let mut config = antmaze();
    config.data.horizon = 32;
    config.networks.model_dim = 32;
    config.networks.embedding_dim = 32;
    config.networks.dim_mult = vec![1, 2, 2];
    config.diffusion.n_updates = 60_000;
    config.diffusion.batch_size = 32;
    config.diffusion.learning_rate = 5e-4;
    config.diffusion.ema_rate = 0.999;
    config.reward.interval = 2;
    config.reward.learning_rate = 5e-4;
    config.planning.sampling_steps = 10;
    config.planning.n_candidates = 8;
    config.checkpoint_interval = 1000;
    config
}

fn smoke() -> Config {
    let mut config = cpu();
    config.data.horizon = 4;
    config.networks.model_dim = 16;
    config.networks.embedding_dim = 16;
    config.networks.dim_mult = vec![1, 2];
    config.diffusion.n_updates = 24;
    config.diffusion.batch_size = 8;
    config.diffusion.ema_rate = 0.9;
    config.reward.ema_rate = 0.9;
    config.planning.sampling_steps = 3;
    config.planning.n_candidates = 4;
    config.checkpoint_interval = 8;
    config
}

fn smoke_antmaze() -> Config {
    let (mut config, maze) = (smoke(), antmaze());
    config.data = DataConfig {
        horizon: config.data.horizon,
        ..maze.data
    };
    config.planning.guidance_weight = maze.planning.guidance_weight;
    config.planning.curiosity_weight = maze.planning.curiosity_weight;
    config
}

/// Curiosity-Diffuser's part of a preset.
pub(crate) fn curiosity(name: &str) -> CuriosityConfig {
    let mut config = CuriosityConfig {
        n_updates: 300_000,
        batch_size: 1024,
        learning_rate: 1e-3,
        ema_rate: 0.995,
        out_dim: 64,
        subset: Subset::Successful,
    };
    match name {
        "cpu" | "cpu-antmaze" => {
            config.n_updates = 10_000;
            config.batch_size = 128;
        }
        "smoke" | "smoke-antmaze" => {
            config.n_updates = 16;
            config.batch_size = 8;
            config.ema_rate = 0.9;
        }
        _ => {}
    }
    config
}

/// ReDiffuser's part of a preset, as compared in Curiosity-Diffuser's paper.
pub(crate) fn confidence(name: &str) -> ConfidenceConfig {
    let mut config = ConfidenceConfig {
        rule: ConfidenceRule::Windows,
        n_updates: 300_000,
        batch_size: 64,
        learning_rate: 3e-4,
        hidden: vec![256, 256],
        target_hidden: vec![256, 256],
        out_dim: 64,
        n_plans: 4096,
        top_candidates: 4,
        scaling: 0.2,
    };
    match name {
        "cpu" | "cpu-antmaze" => {
            config.n_updates = 20_000;
            config.n_plans = 1024;
        }
        "smoke" | "smoke-antmaze" => {
            config.n_updates = 16;
            config.batch_size = 8;
            config.n_plans = 16;
        }
        _ => {}
    }
    config
}
