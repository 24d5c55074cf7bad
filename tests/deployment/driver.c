/* Reads the memory and the rhythm to start with, then stereo pictures; writes u, velocity and all targets of each. */
#include <stdio.h>

#include "nervous_system.h"

static ns_state robot;
static ns_output output;
static uint8_t pictures[NS_EYES][NS_HEIGHT][NS_WIDTH];

int main(void)
{
    ns_init(&robot);
    fprintf(stderr, "%zu\n", sizeof robot);
    if (fread(&robot.navigator, sizeof robot.navigator, 1, stdin) != 1 || fread(&robot.cpg, sizeof robot.cpg, 1, stdin) != 1) {
        return 1;
    }
    while (fread(pictures, sizeof pictures, 1, stdin) == 1) {
        ns_see(&robot, pictures[NS_LEFT][0], pictures[NS_RIGHT][0], &output);
        fwrite(output.u, sizeof output.u, 1, stdout);
        fwrite(output.velocity, sizeof output.velocity, 1, stdout);
        for (int substep = 0; substep < NS_SUBSTEPS; substep++) {
            ns_move(&robot, output.targets);
            fwrite(output.targets, sizeof output.targets, 1, stdout);
        }
    }
    return 0;
}
