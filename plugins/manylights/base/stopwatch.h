#pragma once

#include <chrono>

namespace manylights {

/// Time since it was made
class Stopwatch {
public:
    float milliseconds() const {
        auto time = std::chrono::steady_clock::now() - m_start;
        return std::chrono::duration<float, std::milli>(time).count();
    }

private:
    std::chrono::steady_clock::time_point m_start = std::chrono::steady_clock::now();
};

} // namespace manylights
