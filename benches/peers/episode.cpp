// Plays flotilla's episode in a plain C++ loop: one team at a time per OpenMP thread.
//
//   g++ -O3 -march=native -ffast-math -fopenmp -o episode episode.cpp
//   ./episode LAYOUT TEAMS REPEATS [SEED]
//
// Prints one JSON line. The time includes the episode and the scores G, D and Df of every leader, but not drawing the
// weights.

#include <algorithm>
#include <bit>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <random>

#include <omp.h>

#include "world.h"

// A team's state, and the records of an episode for its credits. Each thread has one, and reuses it for all its teams.
struct Team {
    std::vector<float> x, y, hx, hy, speed;         // state: position, heading (a unit vector), speed
    std::vector<float> turn, wanted_speed;          // the decisions of this step
    std::vector<int> seen;                          // [followers][leaders]: steps in which the follower saw the leader
    std::vector<uint32_t> sets;                     // [steps][pois]: the agents near each POI, one bit per agent

    explicit Team(const World& w)
        : x(w.agents), y(w.agents), hx(w.agents), hy(w.agents), speed(w.agents), turn(w.agents), wanted_speed(w.agents),
          seen(w.followers * w.leaders), sets(w.steps * w.pois) {}

    void start(const World& w) {
        x = w.x;
        y = w.y;
        std::fill(hx.begin(), hx.end(), 0.0f);
        std::fill(hy.begin(), hy.end(), 1.0f);
        std::fill(speed.begin(), speed.end(), 0.0f);
        std::fill(seen.begin(), seen.end(), 0);
    }
};

// Adds an entity at offset (rx, ry) to the density of its quadrant, for a leader with heading (hx, hy). The quadrants
// are back right, front right, front left, and back left.
inline void sense(float rx, float ry, float hx, float hy, float range, float* quadrants) {
    float d = std::sqrt(rx * rx + ry * ry);
    if (d > range) return;
    float fx = rx * hx + ry * hy;
    float fy = ry * hx - rx * hy;
    bool left = fy > 0 || (fy == 0 && fx >= 0);
    bool front = fx > 0 || (fx == 0 && fy <= 0);
    int quadrant = left ? (front ? 2 : 3) : (front ? 1 : 0);
    quadrants[quadrant] += 1 - d / DIAGONAL;
}

void lead(const World& w, Team& team, int i, const float* weights) {
    float x = team.x[i], y = team.y[i], inputs[INPUTS] = {};
    for (int p = 0; p < w.pois; ++p)
        sense(w.poi_x[p] - x, w.poi_y[p] - y, team.hx[i], team.hy[i], 1e30f, inputs);
    for (int j = 0; j < w.agents; ++j)
        if (j != i) sense(team.x[j] - x, team.y[j] - y, team.hx[i], team.hy[i], AGENT_RANGE, inputs + 4);
    for (int k = 0; k < 4; ++k) {
        inputs[k] /= w.pois;
        inputs[4 + k] /= w.agents;
    }

    float hidden[HIDDEN], outputs[OUTPUTS];
    for (int h = 0; h < HIDDEN; ++h) {
        float sum = weights[INPUTS * HIDDEN + h];
        for (int k = 0; k < INPUTS; ++k) sum += inputs[k] * weights[k * HIDDEN + h];
        hidden[h] = std::tanh(sum);
    }
    weights += (INPUTS + 1) * HIDDEN;
    for (int o = 0; o < OUTPUTS; ++o) {
        float sum = weights[HIDDEN * OUTPUTS + o];
        for (int h = 0; h < HIDDEN; ++h) sum += hidden[h] * weights[h * OUTPUTS + o];
        outputs[o] = std::tanh(sum);
    }
    team.turn[i] = PI * outputs[0];
    team.wanted_speed[i] = (outputs[1] + 1) / 2 * MAX_SPEED;
}

// Returns the push of the two walls of one axis on an agent at this coordinate.
inline float wall_push(float at, bool& near) {
    float push = 0;
    if (at <= REPULSION_RADIUS) {
        push += WALL_GAIN * (REPULSION_RADIUS - at);
        near = true;
    }
    if (MAP - at <= REPULSION_RADIUS) {
        push -= WALL_GAIN * (REPULSION_RADIUS - (MAP - at));
        near = true;
    }
    return push;
}

void follow(const World& w, Team& team, int i) {
    float near_x = 0, near_y = 0, far_x = 0, far_y = 0;
    int near = 0, far = 0;
    for (int j = 0; j < w.agents; ++j) {
        if (j == i) continue;
        float rx = team.x[j] - team.x[i], ry = team.y[j] - team.y[i];
        float d2 = rx * rx + ry * ry;
        if (d2 > ATTRACTION_RADIUS * ATTRACTION_RADIUS) continue;
        if (j < w.leaders) team.seen[(i - w.leaders) * w.leaders + j] += 1;
        if (d2 <= REPULSION_RADIUS * REPULSION_RADIUS) {
            near_x += rx;
            near_y += ry;
            near += 1;
        } else {
            far_x += rx;
            far_y += ry;
            far += 1;
        }
    }
    bool wall = false;
    float sx = wall_push(team.x[i], wall), sy = wall_push(team.y[i], wall);
    if (near > 0) {
        sx -= near_x / near * (REPULSION_GAIN / REPULSION_RADIUS);
        sy -= near_y / near * (REPULSION_GAIN / REPULSION_RADIUS);
    }
    if (far > 0) {
        sx += far_x / far * (ATTRACTION_GAIN / ATTRACTION_RADIUS);
        sy += far_y / far * (ATTRACTION_GAIN / ATTRACTION_RADIUS);
    }

    float size = std::sqrt(sx * sx + sy * sy);
    team.turn[i] = 0;
    if (near + far == 0 && !wall) {
        team.wanted_speed[i] = team.speed[i];
    } else if (size == 0) {
        team.wanted_speed[i] = 0;
    } else {
        float along = sx * team.hx[i] + sy * team.hy[i];
        float across = sy * team.hx[i] - sx * team.hy[i];
        team.turn[i] = std::atan2(across, along);
        team.wanted_speed[i] = along > 0 ? size : MIN_SPEED;
    }
}

void move(const World& w, Team& team) {
    for (int i = 0; i < w.agents; ++i) {
        float turn = std::clamp(team.turn[i], -MAX_TURN, MAX_TURN);
        float c = std::cos(turn), s = std::sin(turn);
        float hx = team.hx[i] * c - team.hy[i] * s, hy = team.hx[i] * s + team.hy[i] * c;
        float change = std::clamp(team.wanted_speed[i] - team.speed[i], -MAX_SPEED_CHANGE, MAX_SPEED_CHANGE);
        float speed = std::clamp(team.speed[i] + change, MIN_SPEED, MAX_SPEED);
        team.hx[i] = hx;
        team.hy[i] = hy;
        team.speed[i] = speed;
        team.x[i] = std::clamp(team.x[i] + speed * DT * hx, 0.0f, MAP);
        team.y[i] = std::clamp(team.y[i] + speed * DT * hy, 0.0f, MAP);
    }
}

void couple(const World& w, Team& team, int step) {
    for (int p = 0; p < w.pois; ++p) {
        uint32_t set = 0;
        for (int i = 0; i < w.agents; ++i) {
            float rx = w.poi_x[p] - team.x[i], ry = w.poi_y[p] - team.y[i];
            if (rx * rx + ry * ry <= OBSERVATION_RADIUS * OBSERVATION_RADIUS) set |= 1u << i;
        }
        team.sets[step * w.pois + p] = set;
    }
}

// Returns the share of observed POIs without the agents of `removed`.
float score(const World& w, const Team& team, uint32_t removed) {
    int observed = 0;
    for (int p = 0; p < w.pois; ++p)
        for (int step = 0; step < w.steps; ++step)
            if (std::popcount(team.sets[step * w.pois + p] & ~removed) >= w.coupling) {
                observed += 1;
                break;
            }
    return float(observed) / w.pois;
}

// Sets the group of each leader: itself and its followers, one bit per agent. A follower belongs to the leader that it
// saw most often.
void assign(const World& w, const Team& team, uint32_t* groups) {
    for (int i = 0; i < w.leaders; ++i) groups[i] = 1u << i;
    for (int f = 0; f < w.followers; ++f) {
        const int* seen = &team.seen[f * w.leaders];
        int most = std::max_element(seen, seen + w.leaders) - seen;
        if (seen[most] > 0) groups[most] |= 1u << (w.leaders + f);
    }
}

int main(int argc, char** argv) {
    World world;
    int teams = argc > 2 ? std::atoi(argv[2]) : 0, repeats = argc > 3 ? std::atoi(argv[3]) : 0;
    if (argc < 4 || argc > 5 || !make_world(argv[1], world) || teams < 1 || repeats < 1) {
        std::fprintf(stderr, "usage: episode generally_forward|strictly_forward|chaotic TEAMS REPEATS [SEED]\n");
        return 2;
    }
    const World& w = world;

    std::mt19937 random(argc > 4 ? std::atoi(argv[4]) : 0);
    std::normal_distribution<float> normal;
    std::vector<float> weights(size_t(teams) * w.leaders * WEIGHTS);
    for (float& weight : weights) weight = normal(random);

    std::vector<float> g(teams), d(size_t(teams) * w.leaders), df(size_t(teams) * w.leaders);
    std::vector<double> rates;
    for (int repeat = 0; repeat < repeats; ++repeat) {
        auto begin = std::chrono::steady_clock::now();
#pragma omp parallel
        {
            Team team(w);
            std::vector<uint32_t> groups(w.leaders);
#pragma omp for
            for (int t = 0; t < teams; ++t) {
                const float* policies = &weights[size_t(t) * w.leaders * WEIGHTS];
                team.start(w);
                for (int step = 0; step < w.steps; ++step) {
                    for (int i = 0; i < w.leaders; ++i) lead(w, team, i, policies + i * WEIGHTS);
                    for (int i = w.leaders; i < w.agents; ++i) follow(w, team, i);
                    move(w, team);
                    couple(w, team, step);
                }
                g[t] = score(w, team, 0);
                assign(w, team, groups.data());
                for (int i = 0; i < w.leaders; ++i) {
                    d[size_t(t) * w.leaders + i] = g[t] - score(w, team, 1u << i);
                    df[size_t(t) * w.leaders + i] = g[t] - score(w, team, groups[i]);
                }
            }
        }
        std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - begin;
        rates.push_back(double(teams) * w.steps / seconds.count());
    }

    auto mean = [](const std::vector<float>& values) {
        double sum = 0;
        for (float value : values) sum += value;
        return sum / values.size();
    };
    double mean_g = mean(g), variance = 0;
    for (float value : g) variance += (value - mean_g) * (value - mean_g) / teams;
    std::sort(rates.begin(), rates.end());
    double median = (rates[(repeats - 1) / 2] + rates[repeats / 2]) / 2;
    std::printf("{\"peer\": \"c++\", \"layout\": \"%s\", \"teams\": %d, \"agents\": %d, \"steps\": %d, ", argv[1], teams,
                w.agents, w.steps);
    std::printf("\"team_steps_per_s\": %.1f, \"best_team_steps_per_s\": %.1f, ", median, rates.back());
    std::printf("\"mean_g\": %.6f, \"sd_g\": %.6f, \"mean_d\": %.6f, \"mean_df\": %.6f, \"threads\": %d}\n", mean_g,
                std::sqrt(variance), mean(d), mean(df), omp_get_max_threads());
}
