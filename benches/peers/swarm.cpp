// A peer for large teams: boids in a grid of cells, in plain C++ with the compiler's vectors and -ffast-math. Unlike flotilla it
// has no policies, POIs, credits or equal bits; its sums depend on the order of agents.
//
//     g++ -O3 -march=native -ffast-math benches/peers/swarm.cpp -o swarm && ./swarm AGENTS NEIGHBOURS
//
// The rule is that of benches/swarms.py: away from the mean offset of those within 0.3 units, towards that of those within 1.
// Prints nanoseconds per agent and step, the median of five runs of 20 steps, on one thread.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <vector>

struct Agents {
    std::vector<float> x, y, hx, hy, speed;
    explicit Agents(size_t count) : x(count), y(count), hx(count, 0), hy(count, 1), speed(count, 0) {}
};

struct Swarm {
    float side;
    int columns;
    Agents now, next;
    std::vector<int> starts, cells;

    Swarm(int count, float side)
        : side(side), columns(int(side) + 1), now(count), next(count), starts(columns * columns + 2), cells(count) {
        std::mt19937 random(1);
        std::uniform_real_distribution<float> place(0, side);
        for (int agent = 0; agent < count; agent++) next.x[agent] = place(random), next.y[agent] = place(random);
        sort();
    }

    int cell(float at) const { return std::clamp(int(at), 0, columns - 1); }

    // A counting sort by cell, row by row, from the states after the step.
    void sort() {
        std::fill(starts.begin(), starts.end(), 0);
        int count = int(cells.size());
        for (int agent = 0; agent < count; agent++) {
            cells[agent] = cell(next.y[agent]) * columns + cell(next.x[agent]);
            starts[cells[agent] + 2]++;
        }
        for (size_t index = 1; index < starts.size(); index++) starts[index] += starts[index - 1];
        for (int agent = 0; agent < count; agent++) {
            int slot = starts[cells[agent] + 1]++;
            now.x[slot] = next.x[agent], now.y[slot] = next.y[agent];
            now.hx[slot] = next.hx[agent], now.hy[slot] = next.hy[agent], now.speed[slot] = next.speed[agent];
        }
    }

    void step() {
        const float dt = 0.1f, most = 0.5f, turn = std::cos(0.5f), turn_sine = std::sin(0.5f);
        for (int agent = 0; agent < int(cells.size()); agent++) {
            float x = now.x[agent], y = now.y[agent];
            float near_x = 0, near_y = 0, near_count = 0, far_x = 0, far_y = 0, far_count = 0;
            int left = cell(x - 1), right = cell(x + 1);
            for (int row = cell(y - 1); row <= cell(y + 1); row++) {
                const float *xs = now.x.data(), *ys = now.y.data();
                int last = starts[row * columns + right + 1];
                for (int other = starts[row * columns + left]; other < last; other++) {
                    float dx = xs[other] - x, dy = ys[other] - y, d2 = dx * dx + dy * dy;
                    float near = d2 <= 0.09f ? 1.0f : 0.0f, far = (d2 <= 1.0f ? 1.0f : 0.0f) - near;
                    near_x += near * dx, near_y += near * dy, near_count += near;
                    far_x += far * dx, far_y += far * dy, far_count += far;
                }
            }
            // The agent itself has no offset.
            float near_scale = -1 / 0.3f / std::max(near_count - 1, 1.0f), far_scale = 0.2f / std::max(far_count, 1.0f);
            float fx = near_x * near_scale + far_x * far_scale, fy = near_y * near_scale + far_y * far_scale;
            float size = std::sqrt(fx * fx + fy * fy), hx = now.hx[agent], hy = now.hy[agent];
            if (size > 0) {
                float ux = fx / size, uy = fy / size, sine = hx * uy - hy * ux > 0 ? turn_sine : -turn_sine;
                bool reached = hx * ux + hy * uy >= turn;
                float turned_x = hx * turn - hy * sine, turned_y = hx * sine + hy * turn;
                hx = reached ? ux : turned_x, hy = reached ? uy : turned_y;
            }
            float speed = std::clamp(size, now.speed[agent] - 0.3f, now.speed[agent] + 0.3f);
            speed = std::min(speed, most);
            next.x[agent] = std::clamp(x + speed * dt * hx, 0.0f, side);
            next.y[agent] = std::clamp(y + speed * dt * hy, 0.0f, side);
            next.hx[agent] = hx, next.hy[agent] = hy, next.speed[agent] = speed;
        }
        sort();
    }
};

int main(int count, char **words) {
    if (count != 3) return std::fprintf(stderr, "usage: swarm AGENTS NEIGHBOURS\n"), 2;
    int agents = std::atoi(words[1]);
    float neighbours = std::atof(words[2]);
    std::vector<double> times;
    for (int run = 0; run < 5; run++) {
        Swarm swarm(agents, std::max(5.0f, std::sqrt(agents * 3.14159265f / neighbours)));
        auto start = std::chrono::steady_clock::now();
        for (int step = 0; step < 20; step++) swarm.step();
        std::chrono::duration<double, std::nano> time = std::chrono::steady_clock::now() - start;
        times.push_back(time.count() / 20 / agents);
    }
    std::sort(times.begin(), times.end());
    std::printf("%.1f\n", times[2]);
}
