#pragma once

namespace manylights {

/// Emission of an emitter, or of a part of it, as the rows of the light table hold it: three
/// numbers in RGB and monochrome variants, D65 times an upsampled colour in spectral ones
struct Emission {
    float color[3] = {};
    float scale = 1.f, brightness = 0.f;
    /// Is it the same everywhere on the emitter? If not, nothing of this is valid
    bool constant = false;
    /// Can a row hold it? If not, only `brightness` is valid
    bool tabulated = false;
};

} // namespace manylights
