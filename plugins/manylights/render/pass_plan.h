#pragma once

/**
 * A rendering as a list of passes: which samples of which pixels. Pure numbers, alike for one
 * process, a resumed one and many; whoever renders follows them in their order.
 */

#include <algorithm>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

namespace manylights {

/// Which pixels a pass has, and whether its shadow rays are counted
enum class Role : uint32_t {
    All,   ///< all pixels
    Train, ///< a shuffled sixteenth of them, whose shadow rays teach visibility
    Rest,  ///< all others: completes the training pass of the same samples
};

struct PlannedPass {
    /// Number of a pixel's first sample, and how many there are
    uint32_t first, count;
    Role role;
    /// Which of several independent sequences, 0 for that of the seed itself
    uint32_t scramble;

    uint32_t end() const { return first + count; }
    /// Does learning begin anew?
    bool starts_learning() const { return role == Role::Train && first == 0; }
};

class PassPlan {
public:
    /// Of numbers as users write them, four for each pass; throws if they are no plan
    static PassPlan parse(const std::vector<uint32_t> &numbers) {
        if (numbers.size() % 4 != 0)
            fail("has " + std::to_string(numbers.size()) +
                 " numbers, but must have four for each pass: first sample, count, role, "
                 "scramble");
        PassPlan result;
        for (size_t i = 0; i < numbers.size(); i += 4) {
            std::string pass = "pass " + std::to_string(i / 4) + " ";
            if (numbers[i + 1] == 0)
                fail(pass + "has no samples, but must have a count of at least 1");
            if (numbers[i + 2] > (uint32_t) Role::Rest)
                fail(pass + "has the role " + std::to_string(numbers[i + 2]) +
                     ", but must have 0 (all pixels), 1 (those that train) or 2 (the "
                     "rest)");
            result.m_passes.push_back(
                { numbers[i], numbers[i + 1], Role(numbers[i + 2]), numbers[i + 3] });
        }
        return result;
    }

    /// One pass
    static PassPlan whole(uint32_t spp) {
        PassPlan result;
        result.m_passes.push_back({ 0, spp, Role::All, 0 });
        return result;
    }

    /**
     * The first samples of some pixels train: one half of them, then the other, which already
     * uses what the first has taught. Those of the other pixels and all other samples follow.
     * @param divides  the number of training samples has to divide the whole (their pattern)
     */
    static PassPlan learning(uint32_t spp, uint64_t pixels, bool divides) {
        uint64_t trained = std::max<uint64_t>(pixels / kTrainedPixels, 1);
        uint32_t samples = (uint32_t) std::min<uint64_t>(
            spp, std::max<uint64_t>((kTrainingTotal + trained - 1) / trained, 1));
        while (divides && spp % samples)
            ++samples;
        PassPlan result;
        uint32_t half = samples / 2;
        if (half > 0)
            result.m_passes.push_back({ 0, half, Role::Train, 0 });
        result.m_passes.push_back({ half, samples - half, Role::Train, 0 });
        result.m_passes.push_back({ 0, samples, Role::Rest, 0 });
        if (samples < spp)
            result.m_passes.push_back({ samples, spp - samples, Role::All, 0 });
        return result;
    }

    /// Throws if a pass has samples beyond the number of samples per pixel
    void check(uint32_t spp) const {
        for (size_t i = 0; i < m_passes.size(); ++i)
            if ((uint64_t) m_passes[i].first + m_passes[i].count > spp)
                fail(
                    "pass " + std::to_string(i) + " has the samples " +
                    std::to_string(m_passes[i].first) + " to " +
                    std::to_string((uint64_t) m_passes[i].first + m_passes[i].count - 1) +
                    ", but there are " + std::to_string(spp) + " per pixel: 0 to " +
                    std::to_string(spp - 1));
    }

    /// As users write them
    std::vector<uint32_t> numbers() const {
        std::vector<uint32_t> result;
        for (const PlannedPass &pass : m_passes)
            result.insert(result.end(), { pass.first, pass.count, (uint32_t) pass.role,
                                          pass.scramble });
        return result;
    }

    bool empty() const { return m_passes.empty(); }
    size_t size() const { return m_passes.size(); }
    const PlannedPass &operator[](size_t i) const { return m_passes[i]; }
    auto begin() const { return m_passes.begin(); }
    auto end() const { return m_passes.end(); }

private:
    /// One of 4 x 4 pixels trains
    static constexpr uint32_t kTrainedPixels = 16;
    /// The image has the noise of these samples, too: more of them cost more than they teach
    static constexpr uint64_t kTrainingTotal = 1 << 17;

    [[noreturn]] static void fail(const std::string &what) {
        throw std::runtime_error("manylights: \"plan\": " + what + ".");
    }

    std::vector<PlannedPass> m_passes;
};

} // namespace manylights
