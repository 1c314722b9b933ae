// Plays flotilla's episode in one hand-written persistent CUDA kernel, as an upper bound of the speed of an NVIDIA GPU.
//
//   nvcc -std=c++17 -O3 -arch=native --use_fast_math -o episode_cuda episode.cu
//   ./episode_cuda LAYOUT TEAMS REPEATS [SEED]
//
// NEVER RUN ON A GPU, because none was available. It compiles for sm_90 without spills (nvcc 13, 43 to 64 registers per
// thread). Emulated with one CPU thread per GPU thread, it gave the C++ peer's mean scores.
//
// A block plays 32 teams. Each warp is one agent in all 32 teams, so leaders and followers never share a warp, and lane
// l of every warp is the same team. Headings and speeds are in registers. Positions, weights and the sets of agents
// near each POI stay in shared memory for the whole episode. Weights are read from global memory once, and scores are
// written once. Drawing and uploading the weights is not timed.

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <random>

#include "world.h"

constexpr int LANES = 32;
constexpr int PITCH = LANES + 1;  // avoids bank conflicts in the transposing store and in the loads

__constant__ float start_x[32], start_y[32], poi_x[4], poi_y[4];

// A block's shared memory. `weights` has the index `(leader * WEIGHTS + weight) * PITCH + lane`.
template <int L, int F, int P, int T>
struct Shared {
    float weights[L * WEIGHTS * PITCH];
    float x[L + F][LANES], y[L + F][LANES];
    unsigned sets[T][P][LANES];
    unsigned groups[L][LANES];  // each leader and its followers, one bit per agent
};

__device__ inline void sense(float rx, float ry, float d, float hx, float hy, float* quadrants) {
    float fx = rx * hx + ry * hy, fy = ry * hx - rx * hy;
    bool left = fy > 0 || (fy == 0 && fx >= 0), front = fx > 0 || (fx == 0 && fy <= 0);
    float value = 1 - d * (1 / DIAGONAL);
    quadrants[0] += !left && !front ? value : 0;
    quadrants[1] += !left && front ? value : 0;
    quadrants[2] += left && front ? value : 0;
    quadrants[3] += left && !front ? value : 0;
}

template <int L, int F, int P, int T>
__device__ void lead(const Shared<L, F, P, T>& team, int i, int lane, float hx, float hy, float& turn, float& wanted) {
    float x = team.x[i][lane], y = team.y[i][lane], inputs[INPUTS] = {};
#pragma unroll
    for (int p = 0; p < P; ++p) {
        float rx = poi_x[p] - x, ry = poi_y[p] - y;
        sense(rx, ry, sqrtf(rx * rx + ry * ry), hx, hy, inputs);
    }
    for (int j = 0; j < L + F; ++j) {
        float rx = team.x[j][lane] - x, ry = team.y[j][lane] - y, d2 = rx * rx + ry * ry;
        if (j != i && d2 <= AGENT_RANGE * AGENT_RANGE) sense(rx, ry, sqrtf(d2), hx, hy, inputs + 4);
    }
#pragma unroll
    for (int k = 0; k < 4; ++k) {
        inputs[k] *= 1.0f / P;
        inputs[4 + k] *= 1.0f / (L + F);
    }
    const float* first = team.weights + i * WEIGHTS * PITCH + lane;
    const float* second = first + (INPUTS + 1) * HIDDEN * PITCH;
    float turning = second[HIDDEN * OUTPUTS * PITCH], speeding = second[(HIDDEN * OUTPUTS + 1) * PITCH];
#pragma unroll
    for (int h = 0; h < HIDDEN; ++h) {
        float sum = first[(INPUTS * HIDDEN + h) * PITCH];
#pragma unroll
        for (int k = 0; k < INPUTS; ++k) sum += inputs[k] * first[(k * HIDDEN + h) * PITCH];
        float hidden = tanhf(sum);
        turning += hidden * second[h * OUTPUTS * PITCH];
        speeding += hidden * second[(h * OUTPUTS + 1) * PITCH];
    }
    turn = PI * tanhf(turning);
    wanted = (tanhf(speeding) + 1) * (0.5f * MAX_SPEED);
}

template <int L, int F, int P, int T>
__device__ void follow(const Shared<L, F, P, T>& team, int i, int lane, float hx, float hy, float speed, int* seen,
                       float& turn, float& wanted) {
    float x = team.x[i][lane], y = team.y[i][lane], near_x = 0, near_y = 0, far_x = 0, far_y = 0;
    int near = 0, far = 0;
#pragma unroll
    for (int j = 0; j < L + F; ++j) {
        float rx = team.x[j][lane] - x, ry = team.y[j][lane] - y, d2 = rx * rx + ry * ry;
        bool close = j != i && d2 <= REPULSION_RADIUS * REPULSION_RADIUS;
        bool attracted = j != i && !close && d2 <= ATTRACTION_RADIUS * ATTRACTION_RADIUS;
        if (j < L) seen[j < L ? j : 0] += close || attracted;
        near_x += close ? rx : 0;
        near_y += close ? ry : 0;
        near += close;
        far_x += attracted ? rx : 0;
        far_y += attracted ? ry : 0;
        far += attracted;
    }
    float low_x = REPULSION_RADIUS - x, high_x = REPULSION_RADIUS - (MAP - x);
    float low_y = REPULSION_RADIUS - y, high_y = REPULSION_RADIUS - (MAP - y);
    bool wall = low_x >= 0 || high_x >= 0 || low_y >= 0 || high_y >= 0;
    float pull = ATTRACTION_GAIN / ATTRACTION_RADIUS / max(far, 1);
    float push = REPULSION_GAIN / REPULSION_RADIUS / max(near, 1);
    float sx = WALL_GAIN * (fmaxf(low_x, 0) - fmaxf(high_x, 0)) + far_x * pull - near_x * push;
    float sy = WALL_GAIN * (fmaxf(low_y, 0) - fmaxf(high_y, 0)) + far_y * pull - near_y * push;
    float size = sqrtf(sx * sx + sy * sy), along = sx * hx + sy * hy, across = sy * hx - sx * hy;
    bool alone = near + far == 0 && !wall;
    turn = alone || size == 0 ? 0 : atan2f(across, along);
    wanted = alone ? speed : along > 0 || size == 0 ? size : MIN_SPEED;
}

// Returns G of this lane's team without the agents of `removed`.
template <int C, int L, int F, int P, int T>
__device__ float score(const Shared<L, F, P, T>& team, int lane, unsigned removed) {
    int observed = 0;
    for (int p = 0; p < P; ++p) {
        bool ever = false;
        for (int step = 0; step < T; ++step) ever |= __popc(team.sets[step][p][lane] & ~removed) >= C;
        observed += ever;
    }
    return observed * (1.0f / P);
}

// Plays all teams. The shapes are weights [teams][L][WEIGHTS], g [teams], and d and df [teams][L].
template <int L, int F, int P, int T, int C>
__global__ void __launch_bounds__((L + F) * LANES) play(int teams, const float* weights, float* g, float* d, float* df) {
    extern __shared__ float memory[];
    auto& team = *reinterpret_cast<Shared<L, F, P, T>*>(memory);
    constexpr int AGENTS = L + F, THREADS = AGENTS * LANES;
    const int i = threadIdx.x / LANES, lane = threadIdx.x % LANES;
    const size_t first = size_t(blockIdx.x) * LANES, size = size_t(teams) * L * WEIGHTS;
    for (int k = threadIdx.x; k < LANES * L * WEIGHTS; k += THREADS) {
        size_t at = first * L * WEIGHTS + k;
        team.weights[k % (L * WEIGHTS) * PITCH + k / (L * WEIGHTS)] = at < size ? weights[at] : 0;
    }
    for (int k = threadIdx.x; k < T * P * LANES; k += THREADS) (&team.sets[0][0][0])[k] = 0;
    if (i < L) team.groups[i][lane] = 1u << i;
    float x = start_x[i], y = start_y[i], hx = 0, hy = 1, speed = 0;
    int seen[L] = {};
    team.x[i][lane] = x;
    team.y[i][lane] = y;
    __syncthreads();

    for (int step = 0; step < T; ++step) {
        float turn, wanted;
        if (i < L) {
            lead(team, i, lane, hx, hy, turn, wanted);
        } else {
            follow(team, i, lane, hx, hy, speed, seen, turn, wanted);
        }
        __syncthreads();  // all threads have read the state before the step

        float s, c;
        sincosf(fminf(fmaxf(turn, -MAX_TURN), MAX_TURN), &s, &c);
        float turned = hx * c - hy * s;
        hy = hx * s + hy * c;
        hx = turned;
        speed += fminf(fmaxf(wanted - speed, -MAX_SPEED_CHANGE), MAX_SPEED_CHANGE);
        speed = fminf(fmaxf(speed, MIN_SPEED), MAX_SPEED);
        x = fminf(fmaxf(x + speed * DT * hx, 0), MAP);
        y = fminf(fmaxf(y + speed * DT * hy, 0), MAP);
        team.x[i][lane] = x;
        team.y[i][lane] = y;
#pragma unroll
        for (int p = 0; p < P; ++p) {
            float rx = poi_x[p] - x, ry = poi_y[p] - y;
            if (rx * rx + ry * ry <= OBSERVATION_RADIUS * OBSERVATION_RADIUS) atomicOr(&team.sets[step][p][lane], 1u << i);
        }
        __syncthreads();
    }

    if (i >= L) {
        int owner = 0, most = seen[0];
#pragma unroll
        for (int l = 1; l < L; ++l)
            if (seen[l] > most) {
                owner = l;
                most = seen[l];
            }
        if (most > 0) atomicOr(&team.groups[owner][lane], 1u << i);
    }
    __syncthreads();
    const size_t at = first + lane;
    if (i < L && at < size_t(teams)) {
        float all = score<C>(team, lane, 0);
        if (i == 0) g[at] = all;
        d[at * L + i] = all - score<C>(team, lane, 1u << i);
        df[at * L + i] = all - score<C>(team, lane, team.groups[i][lane]);
    }
}

void check(cudaError_t error) {
    if (error != cudaSuccess) {
        std::fprintf(stderr, "error: %s\n", cudaGetErrorString(error));
        std::exit(1);
    }
}

template <int L, int F, int P, int T, int C>
void run(const char* layout, const World& world, int teams, int repeats, int seed) {
    std::mt19937 random(seed);
    std::normal_distribution<float> normal;
    std::vector<float> weights(size_t(teams) * L * WEIGHTS);
    for (float& weight : weights) weight = normal(random);

    float *policies, *g, *d, *df;
    check(cudaMalloc(&policies, weights.size() * sizeof(float)));
    check(cudaMalloc(&g, size_t(teams) * sizeof(float)));
    check(cudaMalloc(&d, size_t(teams) * L * sizeof(float)));
    check(cudaMalloc(&df, size_t(teams) * L * sizeof(float)));
    check(cudaMemcpy(policies, weights.data(), weights.size() * sizeof(float), cudaMemcpyHostToDevice));
    check(cudaMemcpyToSymbol(start_x, world.x.data(), world.x.size() * sizeof(float)));
    check(cudaMemcpyToSymbol(start_y, world.y.data(), world.y.size() * sizeof(float)));
    check(cudaMemcpyToSymbol(poi_x, world.poi_x.data(), world.poi_x.size() * sizeof(float)));
    check(cudaMemcpyToSymbol(poi_y, world.poi_y.data(), world.poi_y.size() * sizeof(float)));

    auto kernel = play<L, F, P, T, C>;
    constexpr int shared = sizeof(Shared<L, F, P, T>);
    check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, shared));
    cudaEvent_t begin, end;
    check(cudaEventCreate(&begin));
    check(cudaEventCreate(&end));
    std::vector<double> rates;
    for (int repeat = 0; repeat <= repeats; ++repeat) {  // the first repeat warms up
        check(cudaEventRecord(begin));
        kernel<<<(teams + LANES - 1) / LANES, (L + F) * LANES, shared>>>(teams, policies, g, d, df);
        check(cudaGetLastError());
        check(cudaEventRecord(end));
        check(cudaEventSynchronize(end));
        float milliseconds = 0;
        check(cudaEventElapsedTime(&milliseconds, begin, end));
        if (repeat > 0) rates.push_back(double(teams) * T / (milliseconds * 1e-3));
    }

    std::vector<float> scores(size_t(teams) * L);
    auto mean = [&](const float* device, size_t count, double* deviation = nullptr) {
        check(cudaMemcpy(scores.data(), device, count * sizeof(float), cudaMemcpyDeviceToHost));
        double sum = 0, squares = 0;
        for (size_t k = 0; k < count; ++k) {
            sum += scores[k];
            squares += double(scores[k]) * scores[k];
        }
        if (deviation) *deviation = std::sqrt(squares / count - sum / count * (sum / count));
        return sum / count;
    };
    double sd_g = 0, mean_g = mean(g, teams, &sd_g);
    double mean_d = mean(d, size_t(teams) * L), mean_df = mean(df, size_t(teams) * L);
    std::sort(rates.begin(), rates.end());
    double median = (rates[(repeats - 1) / 2] + rates[repeats / 2]) / 2;
    std::printf("{\"peer\": \"cuda\", \"layout\": \"%s\", \"teams\": %d, \"agents\": %d, \"steps\": %d, ", layout, teams,
                L + F, T);
    std::printf("\"team_steps_per_s\": %.1f, \"best_team_steps_per_s\": %.1f, ", median, rates.back());
    std::printf("\"mean_g\": %.6f, \"sd_g\": %.6f, \"mean_d\": %.6f, \"mean_df\": %.6f, \"threads\": %d}\n", mean_g, sd_g,
                mean_d, mean_df, (L + F) * LANES);
}

int main(int argc, char** argv) {
    World world;
    int teams = argc > 2 ? std::atoi(argv[2]) : 0, repeats = argc > 3 ? std::atoi(argv[3]) : 0;
    if (argc < 4 || argc > 5 || !make_world(argv[1], world) || teams < 1 || repeats < 1) {
        std::fprintf(stderr, "usage: episode_cuda generally_forward|strictly_forward|chaotic TEAMS REPEATS [SEED]\n");
        return 2;
    }
    int seed = argc > 4 ? std::atoi(argv[4]) : 0;
    if (world.agents == 12) run<4, 8, 4, 25, 3>(argv[1], world, teams, repeats, seed);
    if (world.agents == 6) run<2, 4, 2, 25, 3>(argv[1], world, teams, repeats, seed);
    if (world.agents == 20) run<4, 16, 4, 50, 5>(argv[1], world, teams, repeats, seed);
}
