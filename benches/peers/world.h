// The worlds of the paper's layouts, in the leader-follower paradigm, for the C++ and the CUDA peer.
#pragma once

#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

constexpr float PI = 3.14159265f;
constexpr float MAP = 50, DIAGONAL = 1.41421356f * MAP;
constexpr float DT = 0.2f;
constexpr float MIN_SPEED = 0, MAX_SPEED = 3, MAX_SPEED_CHANGE = 5 * DT, MAX_TURN = PI / 2 * DT;
constexpr float OBSERVATION_RADIUS = 5, AGENT_RANGE = 5;  // POIs are sensed at any distance
constexpr float ATTRACTION_RADIUS = 5, REPULSION_RADIUS = 1;
constexpr float ATTRACTION_GAIN = 5, REPULSION_GAIN = 1, WALL_GAIN = 1;

// The policy has 8 inputs, 10 hidden units and 2 outputs. The biases are the last row of each layer.
constexpr int INPUTS = 8, HIDDEN = 10, OUTPUTS = 2;
constexpr int WEIGHTS = (INPUTS + 1) * HIDDEN + (HIDDEN + 1) * OUTPUTS;

struct World {
    int leaders = 0, followers = 0, pois = 0, agents = 0;
    int coupling = 3, steps = 25;
    std::vector<float> x, y;          // start positions, leaders first
    std::vector<float> poi_x, poi_y;
};

// Builds the layout with this name. Returns false if there is none.
inline bool make_world(const std::string& layout, World& world) {
    std::vector<float> groups = {10, 20, 30, 40};
    std::vector<std::vector<float>> offsets = {{2, -3}, {-2, -3}};
    if (layout == "strictly_forward") {
        groups = {10, 40};
    } else if (layout == "chaotic") {
        offsets = {{2, -3}, {-2, -3}, {2, 2}, {-2, 2}};
        world.coupling = 5;
        world.steps = 50;
    } else if (layout != "generally_forward") {
        return false;
    }
    for (float group : groups) {
        world.x.push_back(group);
        world.y.push_back(5);
        world.poi_x.push_back(group);
        world.poi_y.push_back(15);
    }
    for (float group : groups)
        for (const auto& offset : offsets) {
            world.x.push_back(group + offset[0]);
            world.y.push_back(5 + offset[1]);
        }
    world.leaders = world.pois = groups.size();
    world.agents = world.x.size();
    world.followers = world.agents - world.leaders;
    return true;
}
