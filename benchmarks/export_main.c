/* Times the exported C program: `export_main PICTURES FRAMES`. For each line on stdin, a run over all pictures. */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "nervous_system.h"

static ns_state robot;
static ns_output output;

static double processor_seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void step(const uint8_t *pictures)
{
    ns_see(&robot, pictures, pictures + NS_WIDTH * NS_HEIGHT, &output);
    for (int substep = 0; substep < NS_SUBSTEPS; substep++) {
        ns_move(&robot, output.targets);
    }
}

int main(int count, char **arguments)
{
    const size_t size = NS_EYES * NS_WIDTH * NS_HEIGHT;
    const int frames = count == 3 ? atoi(arguments[2]) : 0;
    uint8_t *pictures = malloc(size * (size_t)frames);
    FILE *file = count == 3 ? fopen(arguments[1], "rb") : NULL;
    if (!file || !pictures || fread(pictures, size, (size_t)frames, file) != (size_t)frames) {
        return 1;
    }
    ns_init(&robot);
    step(pictures);
    printf("%.6f\n", processor_seconds());
    fflush(stdout);
    while (getchar() != EOF) {
        const double start = processor_seconds();
        for (int frame = 0; frame < frames; frame++) {
            step(pictures + size * (size_t)frame);
        }
        printf("%.6f %.6f\n", (processor_seconds() - start) / frames * 1e3, output.u[NS_LEFT]);
        fflush(stdout);
    }
    return 0;
}
